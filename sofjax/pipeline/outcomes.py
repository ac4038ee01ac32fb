"""What a user chooses by a word, and the outcomes that a user reads: the values are the sentences.

Imports nothing, as the argument parser needs the words.
"""

from enum import StrEnum

# what `calibrate` knows; those of `rig.RIG` and `motion.BIAS`, which would be slow to import
FREE = (
    "height", "pitch", "roll", "yaw", "x", "y", "focal", "cx", "cy", "k1", "k2", "time_offset",
    "line_delay", "distance", "left", "right", "curvature",
)  # fmt: skip
OF_MOUNT = (*FREE[:4], *FREE[-4:])  # of these, what `calibrate mount` fits
OF_RIG = FREE[:-4]  # and what is not the odometer's
LOOPS = ("none", "paper", "smooth")  # after the drive: nothing, the paper's closing, smoothing


class LoopStatus(StrEnum):
    """How far a run came with what is solved after the drive."""

    UNFINISHED = "not finished"  # stays in the report of a run that was killed
    INTERRUPTED = "interrupted"
    SOLVED = "solved"
    NOTHING = "nothing to solve"


class FitVerdict(StrEnum):
    """What a fitted rig is worth."""

    GOOD = "good"
    ROUGH = "rough"
    DOUBTFUL = "doubtful"
    NOT_USABLE = "not usable"


class DriveVerdict(StrEnum):
    """What a drive is worth."""

    GOOD = "good"
    USABLE = "usable: see the warnings"
    DOUBTFUL = "doubtful: a run on it would mislead; see the warnings"
