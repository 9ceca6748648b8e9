"""USD in and out: the only rooms, with ``plugins/``, that import pxr."""
