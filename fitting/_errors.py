"""The one error of this package."""


class FitError(ValueError):
    """A fit was asked for that cannot be done; the message says what is wrong and what would be right."""
