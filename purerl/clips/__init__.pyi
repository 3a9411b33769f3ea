# The public names, each once; `__init__.py` reads this list.
from purerl.clips.body import (
    bare as bare,
    fit as fit,
    kinematics as kinematics,
    own_bodies as own_bodies,
    pack as pack,
)
from purerl.clips.files import read as read, write as write
from purerl.clips.records import (
    Clips as Clips,
    Motion as Motion,
    check_window as check_window,
    choose as choose,
    cut as cut,
    split as split,
)
from purerl.clips.sampling import (
    Tally as Tally,
    count as count,
    draw as draw,
    even_tally as even_tally,
    failure_weights as failure_weights,
)
