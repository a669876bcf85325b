"""The errors a user can meet: one sentence each that says what, which input, what to do."""


class AquaFlowError(Exception):
    """Base of every error that the command line prints as one sentence."""


class InputError(AquaFlowError):
    """A file, folder or stream that cannot be used."""


class ConfigError(AquaFlowError):
    """A config or calibration file with an unknown key or a value out of range."""


class NotMappedError(AquaFlowError):
    """The input was read, but no map could be made of it."""


MAX_QUOTED = 160
"""Characters of another library's message that one of our sentences quotes."""


def first_line(error: BaseException) -> str:
    """What another library said, short enough for a sentence; its kind if it said nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0][:MAX_QUOTED]
