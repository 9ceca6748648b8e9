"""A usdview plug-in: a menu that refines the current frame and shows heat maps."""
