"""The one exception a user is meant to read."""


class UserError(ValueError):
    """Bad input. Its text is a single line that names the thing, the place and the mend.

    The command line prints it as ``error: ...`` and exits with status 2; a library user can catch it as a
    ``ValueError``.
    """
