"""The plants, one file each. A file with an `ID` line and a function `plant(**options)` is found by itself."""
