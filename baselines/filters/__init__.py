"""The filters of the literature, one file per published method."""
