"""The error that a user can cause and mend.

Lives here: one exception. The command line prints it as one line and exits with status 2.
Not here: errors that only a bug can cause; those keep their traceback.
"""

__all__ = ["InputError"]


class InputError(ValueError):
    """Something given to streamfeat cannot be used.

    The message is one line: what is wrong, where (file, topic, message, byte), and what to do.
    """
