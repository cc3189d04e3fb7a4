"""From measured latencies to servers and slots: dimensioning, prediction, the plan file.

Everything starts with :func:`plan_shaping`; each further step takes a plan and returns a plan.
:func:`plan_chain` takes all of them that a :class:`PlanRequest` asks for.
"""

from chainshaper.planning.bands import BandChoice as BandChoice
from chainshaper.planning.chain_plan import ChainPlan as ChainPlan
from chainshaper.planning.chain_plan import Modes as Modes
from chainshaper.planning.chain_plan import band_predictions as band_predictions
from chainshaper.planning.chain_plan import publish_slots as publish_slots
from chainshaper.planning.latencies import read_latencies as read_latencies
from chainshaper.planning.offsets import place_chains as place_chains
from chainshaper.planning.overruns import plan_warnings as plan_warnings
from chainshaper.planning.plan import Plan as Plan
from chainshaper.planning.plan_file import convert_plan as convert_plan
from chainshaper.planning.plan_file import dump_plan as dump_plan
from chainshaper.planning.plan_file import load_plan as load_plan
from chainshaper.planning.plan_file import plan_json as plan_json
from chainshaper.planning.plan_file import save_plan as save_plan
from chainshaper.planning.plan_file import save_plans as save_plans
from chainshaper.planning.profile import Profile as Profile
from chainshaper.planning.request import PlanRequest as PlanRequest
from chainshaper.planning.request import band_choice as band_choice
from chainshaper.planning.request import plan_chain as plan_chain
from chainshaper.planning.several_chains import plan_application as plan_application
from chainshaper.planning.shaping import CallbackTimes as CallbackTimes
from chainshaper.planning.shaping import plan_shaping as plan_shaping
