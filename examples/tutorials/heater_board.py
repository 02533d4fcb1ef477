# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # The logs of a heater board
#
# A board has a heater and a thermometer. The logger reads the thermometer and notes the heater's
# command every 3 s, and resolves 0.1 °C. The command reaches the heater 15 s late. The thermometer
# has a time constant of 12 s, so the temperature of the heater itself is not measured. The heater
# loses heat by convection and by radiation.
#
# The board is simulated here, on two days of about 21 °C and on a colder one, and its three logs
# are written: `python examples/tutorials/heater_board.py [folder]`.

# %%
from pathlib import Path
import sys

import numpy as np
import pandas as pd

# a notebook has arguments of its own
OUT = Path(*[word for word in sys.argv[1:2] if word[0] != '-'] or ['out/tutorials'])
OUT.mkdir(parents=True, exist_ok=True)
PERIOD, STEP, DEAD_TIME = 3.0, 0.1, 15.0  # s
POWER = 5.0  # W at 100 %
CAPACITY, CONVECTION, RADIATION = 12.0, 0.04, 1.5e-10  # J/K, W/K, W/K^4
THERMOMETER, NOISE = 12.0, 0.05  # s, K

# %% [markdown]
# ## A day
#
# The heater takes random steps through its range, held between half a minute and four minutes. The
# equations are integrated in steps of 0.1 s.


# %%
def log(samples: int, room: float, seed: int) -> pd.DataFrame:
    """Return the log of a day, of a room temperature in °C."""
    rng = np.random.default_rng(seed)
    commands: list[float] = []
    while len(commands) < samples:
        commands += [round(rng.uniform(0.0, 80.0), 1)] * rng.integers(10, 80)
    late, each = round(DEAD_TIME / PERIOD), round(PERIOD / STEP)
    acting = [0.0] * late + commands
    heater = thermometer = room
    temperatures = []
    for k in range(samples):
        temperatures.append(thermometer)
        for _ in range(each):
            loss = CONVECTION * (heater - room) + RADIATION * (
                (heater + 273.15) ** 4 - (room + 273.15) ** 4)
            thermometer += STEP * (heater - thermometer) / THERMOMETER
            heater += STEP * (POWER * acting[k] / 100.0 - loss) / CAPACITY
    read = np.round(np.array(temperatures) + NOISE * rng.standard_normal(samples), 1)
    return pd.DataFrame({'time [s]': PERIOD * np.arange(samples),
                         'heater [percent]': commands[:samples], 'temperature [degC]': read})


# %%
for name, samples, room in (('day_1', 600, 21.0), ('day_2', 600, 20.6), ('cold_day', 400, 17.5)):
    file = OUT / f'heater_{name}.csv'
    log(samples, room, seed=samples + round(10 * room)).to_csv(file, index=False)
    print(f'{file}: {samples} rows in {PERIOD * samples / 60:.0f} min')
