"""USD in and out: together with ``plugins/``, the only code importing pxr.

Throughout, ``time`` is a time code, None for the default; ``metres`` the length of one stage unit [m]; ``overrides``
are the values of ``--set``; and ``target`` is the prim to author on.
"""

import os

# USD memory-maps binary layers: a file truncated meanwhile would crash the process. With pread, USD raises an error.
os.environ.setdefault("USDC_USE_PREAD", "1")
