"""What is raised when the input cannot be used: says what, where, and what to do."""


class InputError(ValueError):
    """Input that cannot be used. The message names the source, the first offending row or column, and the remedy."""
