"""The exception for bad input."""


class UserError(ValueError):
    """Bad input. Its text is one line with the wrong value, its place (file, option or argument), and the remedy.

    The command line prints it as ``error: ...`` and exits with status 2. Programs can catch it as a ``ValueError``.
    """
