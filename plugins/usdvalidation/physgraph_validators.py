"""Plug-in of UsdValidation: importing this registers the rules of `physgraph-usd validate`."""

from __future__ import annotations

import logging

from physgraph_usd.usd.check.validators import register

if not register():
    logging.getLogger(__name__).warning("this USD cannot register validators from Python; it takes 26.5 or newer")
