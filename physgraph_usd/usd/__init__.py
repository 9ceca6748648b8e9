"""USD in and out: together with ``plugins/``, the only code importing pxr."""

import os

# USD memory-maps binary layers: a file truncated meanwhile would crash the process. With pread, USD raises an error.
os.environ.setdefault("USDC_USE_PREAD", "1")
