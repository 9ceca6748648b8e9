"""Writing: layers, primvars, chunks and samples; a file is complete or not there."""
