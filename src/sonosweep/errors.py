"""Everything that can go wrong through no fault of the program."""


class SonosweepError(Exception):
    """Anything the user can fix; the command line prints it in one line."""


class ScanError(SonosweepError, ValueError):
    """A scan, a pose, a volume or a setting contradicts itself."""


class FormatError(SonosweepError, ValueError):
    """A file is not what its reader expects."""


class RecipeError(SonosweepError, ValueError):
    """A recipe or a calibration file holds something it must not."""


class TrainingError(SonosweepError, RuntimeError):
    """Training cannot go on: the loss is not a number, or memory is short."""
