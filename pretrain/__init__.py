"""Stage one: representations from pixels and actions alone."""
