"""Loaded last by the server that workers are forked from: what it has loaded is theirs as well, and not looked through.

So no worker loads it again, has to look through it for cycles, nor copies the pages that hold it.
"""

from __future__ import annotations

import gc

import mpc.constrained
import mpc.robust.controller
import mpc.unconstrained  # noqa: F401
import scenarios.campaign.engine.supervisor
import scenarios.campaign.pilot  # noqa: F401

gc.collect()
gc.freeze()
