"""Tracing by a library that `LD_PRELOAD` puts in front of ROS 2: no root, no daemon, no module.

    preload.c, in each process ─► its memory ─► records ─► event tables
                                  memory.py                tables.py

`preload.c` is that library. It sends us the memory of its process with the process's first event
(:mod:`.tracer`); that of a process that runs already is in `/proc` (:mod:`.running`). A thread
reads all memories ten times a second, also what a process wrote that was killed in between. What
puts libraries there is in :mod:`.in_front`. Loops that it sees can be moved (:mod:`.moving`).
"""

from chainshaper.sources.preload.in_front import ANY_ORDER as ANY_ORDER
from chainshaper.sources.preload.in_front import SANITIZER as SANITIZER
from chainshaper.sources.preload.in_front import VARIABLE as VARIABLE
from chainshaper.sources.preload.in_front import in_front as in_front
from chainshaper.sources.preload.in_front import installed_library as installed_library
from chainshaper.sources.preload.in_front import native_library as native_library
from chainshaper.sources.preload.in_front import preloading as preloading
from chainshaper.sources.preload.memory import RECORD as RECORD
from chainshaper.sources.preload.memory import TracedProcess as TracedProcess
from chainshaper.sources.preload.memory import event_names as event_names
from chainshaper.sources.preload.moving import LoopMoved as LoopMoved
from chainshaper.sources.preload.moving import LoopMover as LoopMover
from chainshaper.sources.preload.moving import move_loop as move_loop
from chainshaper.sources.preload.running import NO_PROCESS as NO_PROCESS
from chainshaper.sources.preload.running import memories as memories
from chainshaper.sources.preload.tables import creation_tables as creation_tables
from chainshaper.sources.preload.tables import event_tables as event_tables
from chainshaper.sources.preload.tables import joined_tables as joined_tables
from chainshaper.sources.preload.tracer import PreloadTracer as PreloadTracer
