"""One frame of garments that are solved together: from where their cloth was to where it is."""
