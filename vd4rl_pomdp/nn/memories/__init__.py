"""The memories that come with the package, and what a memory is."""
