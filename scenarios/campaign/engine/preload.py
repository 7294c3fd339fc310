"""Loaded last by the server that workers are forked from: what it has loaded is theirs as well, and no garbage.

So no worker has to look through it, nor copies the pages that hold it.
"""

from __future__ import annotations

import scenarios.campaign.engine.supervisor  # noqa: F401
from scenarios.gc_settings import settle

settle()
