"""Sweeps: one application in many variants, each planned, shaped and simulated.

What a plan, or a change of the application, would do is asked of the simulator, for every
combination of some values. A point of the grid is what a careful person would do by hand:
simulate the application with its chain in front of all others, plan, splice, simulate again.

    grid       axes and their combinations: from names and values to an application and a plan
    points     one point: from these to a row of figures
    workers    many points: in processes of this machine, or on a Dask cluster
    kept_rows  what is finished, on disk, so that a sweep that was ended goes on
    running    the whole
"""

from chainshaper.simulation.sweeping.grid import parse_axis
from chainshaper.simulation.sweeping.running import rows_beside, sweep

__all__ = ["parse_axis", "rows_beside", "sweep"]
