"""Loaded last by the server that workers are forked from: what it has loaded is theirs as well, and lasts.

So no worker has to look through it, nor copies the pages that hold it.
"""

from __future__ import annotations

import scenarios.campaign.keeper  # noqa: F401
from scenarios.gc_tuning import freeze_for_good

freeze_for_good()
