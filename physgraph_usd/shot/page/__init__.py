"""The page of a run: pictures, plots over time, modelled terms with reasons, and warnings, in a single offline file."""
