"""Built-in memories and their base class."""
