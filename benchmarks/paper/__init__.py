"""The paper's results beside ours: a module a figure or table of the paper."""
