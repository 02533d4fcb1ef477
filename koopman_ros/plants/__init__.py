# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Control-affine systems, their steady states, actuators and simulation; imports plant data."""

from koopman_ros.plants.catalogue import build, plant_class, PLANTS
from koopman_ros.plants.constants import (
    Constant,
    constant,
    Constants,
    constants_of,
    estimated_parameters_of,
)
from koopman_ros.plants.excitation import (
    box_episodes,
    ExcitationError,
    random_steps,
    RandomStepDesign,
)
from koopman_ros.plants.library.reactor import (
    one_state_reactor,
    ReactorParameters,
    two_state_reactor,
)
from koopman_ros.plants.library.scalar import scalar_example
from koopman_ros.plants.library.two_state import two_state_example
from koopman_ros.plants.process import Actuator, Process, sensor_noise
from koopman_ros.plants.recovery import recoverable
from koopman_ros.plants.simulation import (
    advance,
    IntegrationError,
    IntegrationFailure,
    sample_derivatives,
    simulate,
)
from koopman_ros.plants.system import (
    ControlAffineSystem,
    describe,
    equilibrium_input,
    EquilibriumError,
    steady_state,
)

__all__ = [
    'PLANTS',
    'Actuator',
    'Constant',
    'Constants',
    'ControlAffineSystem',
    'EquilibriumError',
    'ExcitationError',
    'IntegrationError',
    'IntegrationFailure',
    'Process',
    'RandomStepDesign',
    'ReactorParameters',
    'advance',
    'box_episodes',
    'build',
    'constant',
    'constants_of',
    'describe',
    'equilibrium_input',
    'estimated_parameters_of',
    'one_state_reactor',
    'plant_class',
    'random_steps',
    'recoverable',
    'sample_derivatives',
    'scalar_example',
    'sensor_noise',
    'simulate',
    'steady_state',
    'two_state_example',
    'two_state_reactor',
]
