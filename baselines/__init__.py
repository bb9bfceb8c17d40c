"""Reference diagnosers: trivial ones, the filters of the literature, learned ones. One file each, discovered."""
