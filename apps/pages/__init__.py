"""One module a page: which choices, which charts, what to look at."""
