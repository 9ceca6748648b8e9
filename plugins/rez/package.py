"""Rez package: `rez-build --install` here, from a checkout; `rez-env physgraph_usd -- physgraph-usd --help`."""

name = "physgraph_usd"
version = "0.2.0"
description = "Refine coarse animated garments in USD shots into fine cloth with physical wrinkles"
requires = ["python-3.11+<3.15"]
tools = ["physgraph-usd"]
# The studio's own USD is in the environment; pip would bring a second one with the extra [usd].
build_command = "python -m pip install {root}/../.. --target {install_path}/python --no-compile"


def commands():
    """Environment of the package."""
    env.PYTHONPATH.prepend("{root}/python")
    env.PATH.prepend("{root}/python/bin")
    env.PXR_PLUGINPATH_NAME.append("{root}/python/physgraph_usd/schemas")
