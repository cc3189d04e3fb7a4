"""From measured latencies to servers and slots: dimensioning, prediction, the plan file.

Everything starts with :func:`plan_shaping`; each further step takes a plan and returns a plan.
:func:`plan_chain` takes all of them that a :class:`PlanRequest` asks for.
"""

from chainshaper.planning.application_plan import ApplicationPlan as ApplicationPlan
from chainshaper.planning.bands import BandChoice as BandChoice
from chainshaper.planning.bands import choose_bands as choose_bands
from chainshaper.planning.bands import with_bands as with_bands
from chainshaper.planning.bands import with_long_slot as with_long_slot
from chainshaper.planning.margins import read_latencies as read_latencies
from chainshaper.planning.offsets import place_chains as place_chains
from chainshaper.planning.overruns import plan_warnings as plan_warnings
from chainshaper.planning.plan import Margin as Margin
from chainshaper.planning.plan import Modes as Modes
from chainshaper.planning.plan import Plan as Plan
from chainshaper.planning.plan import Prediction as Prediction
from chainshaper.planning.plan import Server as Server
from chainshaper.planning.plan import ShapingNode as ShapingNode
from chainshaper.planning.plan import Slot as Slot
from chainshaper.planning.plan import Thread as Thread
from chainshaper.planning.plan import band_predictions as band_predictions
from chainshaper.planning.plan import publish_slots as publish_slots
from chainshaper.planning.plan import server_of as server_of
from chainshaper.planning.plan_file import dump_plan as dump_plan
from chainshaper.planning.plan_file import load_application_plan as load_application_plan
from chainshaper.planning.plan_file import load_plan as load_plan
from chainshaper.planning.plan_file import plan_json as plan_json
from chainshaper.planning.plan_file import save_application_plan as save_application_plan
from chainshaper.planning.plan_file import save_plan as save_plan
from chainshaper.planning.plan_file import save_plans as save_plans
from chainshaper.planning.profile import Profile as Profile
from chainshaper.planning.request import PlanRequest as PlanRequest
from chainshaper.planning.request import band_choice as band_choice
from chainshaper.planning.request import plan_chain as plan_chain
from chainshaper.planning.several_chains import plan_application as plan_application
from chainshaper.planning.shaping import CallbackTimes as CallbackTimes
from chainshaper.planning.shaping import let_per_callback as let_per_callback
from chainshaper.planning.shaping import let_per_chain as let_per_chain
from chainshaper.planning.shaping import over_cores as over_cores
from chainshaper.planning.shaping import plan_shaping as plan_shaping
from chainshaper.planning.shaping import server_per_callback as server_per_callback
from chainshaper.planning.shaping import server_per_chain as server_per_chain
from chainshaper.planning.shaping import with_first_node_apart as with_first_node_apart
from chainshaper.planning.shaping import with_sink as with_sink
