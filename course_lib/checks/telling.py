"""What is said of an exception, wherever it was caught: it needs nothing else, and pages have it, too."""


def text_of(error: BaseException) -> str:
    """What the exception says, or nothing if it refuses to say it."""
    try:
        return str(error)[:500]
    except BaseException:
        return ""
