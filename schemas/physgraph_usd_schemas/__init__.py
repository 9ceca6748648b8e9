"""The codeless USD schemas of physgraph-usd; importing this registers them.

USD accepts schemas only before it has read its first prim definition: import this before a stage is opened.
"""

from pathlib import Path

from pxr import Plug

if not Plug.Registry().GetPluginWithName("physgraph"):
    Plug.Registry().RegisterPlugins(str(Path(__file__).parent))
