"""Loaded last by the server that workers are forked from: what it has loaded is theirs as well, and not looked through.

So no worker loads it again, has to look through it for cycles, nor copies the pages that hold it.
"""

from __future__ import annotations

import scenarios.campaign.engine.supervisor
import scenarios.campaign.pilot  # noqa: F401
from scenarios.gc_settings import settle

settle()
