"""What `fdi-gym new` writes: text files in which NAME, PACKAGE and ID are replaced."""
