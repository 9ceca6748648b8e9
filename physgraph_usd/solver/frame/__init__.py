"""One frame of a group of garments: from the cloth's start to its solution."""
