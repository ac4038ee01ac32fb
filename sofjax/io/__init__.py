"""Files in and out: drives, cameras, trajectories, maps and settings.

Whatever a file holds that cannot be used raises `InputError`, whose text is one sentence.
"""

from sofjax.io.errors import InputError as InputError
