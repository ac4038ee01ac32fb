"""A place seen again: recognised by the geometry of its lines, and the loop closed there.

`close` smooths a drive, and again with each loop that it finds. `find` looks for the lines of the
last metres among those of long ago, for every pose that the uncertainty allows; `distribute` is the
paper's closing, the error spread evenly back along the path.
"""

from sofjax.loop_closure.close import ClosedDrive as ClosedDrive
from sofjax.loop_closure.close import close as close
from sofjax.loop_closure.distribute_error import distribute as distribute
from sofjax.loop_closure.place_recognition import Closing as Closing
from sofjax.loop_closure.place_recognition import ClosingConfig as ClosingConfig
from sofjax.loop_closure.place_recognition import find as find
from sofjax.loop_closure.revisits import AGO as AGO
from sofjax.loop_closure.revisits import Revisit as Revisit
from sofjax.loop_closure.revisits import TimedLines as TimedLines
from sofjax.loop_closure.revisits import closed as closed
from sofjax.loop_closure.revisits import driven as driven
from sofjax.loop_closure.revisits import joined_map as joined_map
from sofjax.loop_closure.revisits import moved_lines as moved_lines
from sofjax.loop_closure.revisits import revisits as revisits
from sofjax.loop_closure.revisits import solved as solved
