"""The one exception that a user may see."""


class UserError(ValueError):
    """Bad input: the message is one line that says what is wrong, where, and what to do.

    The command line prints the message and exits with code 2; a library caller catches a ValueError.
    """
