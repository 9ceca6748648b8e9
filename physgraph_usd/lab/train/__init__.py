"""Training: patches, the loop and the record of what was trained."""
