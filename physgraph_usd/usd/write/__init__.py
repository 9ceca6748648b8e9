"""Writing: layers, primvars, samples; a file is complete or not there."""
