"""The memories that come with the package, one file each, and what a memory is."""
