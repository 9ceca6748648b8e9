"""USD in and out: the only rooms, with ``plugins/``, that import pxr."""

import os

# USD maps binary layers into memory: one that is cut short meanwhile would end the process. Read by pread, it raises.
os.environ.setdefault("USDC_USE_PREAD", "1")
