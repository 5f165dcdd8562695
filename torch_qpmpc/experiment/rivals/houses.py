"""The rivals of the tasks ``house`` and ``house_wall``, and their costs.

Settings were chosen on the days that seed 7 draws, and those of the tuned planner on seed 0;
evaluations use others.
"""

from __future__ import annotations

from dataclasses import replace

from torch_qpmpc.experiment.heating import known_model
from torch_qpmpc.experiment.rivals import tightened
from torch_qpmpc.experiment.rivals.heating import KalmanHouseMPC, Omniscient, Thermostat, house_mpc
from torch_qpmpc.experiment.rivals.rival import Rival
from torch_qpmpc.experiment.rivals.tuned_planner import TUNED, planner

#: Steps by which a thermostat's timer raises the setpoint early: two hours.
TIMER = 8
#: The longer horizon: a day.
LONG = 96

#: Rivals for leap-c's room.
HOUSE_RIVALS = {
    "thermostat": Rival(lambda house: Thermostat(house, offset=1.0, gain=8.0)),
    "thermostat with timer": Rival(
        lambda house: Thermostat(house, offset=0.75, gain=10.0, ahead=TIMER)
    ),
    "planner (R = 2)": Rival(
        lambda house: house_mpc(house, known_model(replace(house, R=2.0))).policy, sees={"past": 1}
    ),
    "tuned planner": Rival(lambda house: planner(house, TUNED).policy, sees={"past": 1}),
    "tightened": Rival(tightened.house, sees={"past": 1}),
    "omniscient": Rival(Omniscient),
}

#: Rivals for the house with a hidden wall.
HOUSE_WALL_RIVALS = {
    "thermostat": Rival(lambda house: Thermostat(house, offset=2.0, gain=2.0)),
    "thermostat with timer": Rival(
        lambda house: Thermostat(house, offset=0.5, gain=6.0, ahead=TIMER)
    ),
    "Kalman filter": Rival(lambda house: KalmanHouseMPC(house, margin=0.05)),
    f"Kalman filter, N = {LONG}": Rival(
        lambda house: KalmanHouseMPC(house, margin=0.05), sees={"horizon": LONG}, slow=True
    ),
    "omniscient": Rival(Omniscient),
    f"omniscient, N = {LONG}": Rival(Omniscient, sees={"horizon": LONG}, slow=True),
}
