"""The page of a run: pictures, plots over time, what was modelled and why, warnings; one file that needs no network."""
