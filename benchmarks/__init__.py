"""What is measured from a checkout and not installed: speed, the grid of methods on plants, the papers' figures again."""
