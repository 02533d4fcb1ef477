# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What is controlled: control-affine systems and their simulation; imports nothing of ours."""

from koopman_ros.plants.actuator import ActuatedProcess, Actuator, with_input_lag
from koopman_ros.plants.equilibria import (
    eigenvalues,
    equilibrium,
    equilibrium_input,
    EquilibriumError,
    fold,
)
from koopman_ros.plants.exact_lift import ExactLift
from koopman_ros.plants.excitation import (
    Excitation,
    ExcitationError,
    random_steps,
    RandomStepDesign,
)
from koopman_ros.plants.integration import (
    IntegrationError,
    IntegrationFailure,
    IntegratorSettings,
)
from koopman_ros.plants.process import Process
from koopman_ros.plants.reactor import (
    NOMINAL_COOLANT_TEMPERATURE,
    one_state_reactor,
    ReactorParameters,
    two_state_reactor,
)
from koopman_ros.plants.scalar import scalar_exact_lift, scalar_example
from koopman_ros.plants.sensor import in_steps, sensor_noise
from koopman_ros.plants.simulation import advance, simulate, simulate_many
from koopman_ros.plants.system import ControlAffineSystem, FloatArray
from koopman_ros.plants.trajectory import DerivativeSamples, sample_derivatives, Trajectory
from koopman_ros.plants.two_state import two_state_exact_lift, two_state_example

__all__ = [
    'NOMINAL_COOLANT_TEMPERATURE',
    'ActuatedProcess',
    'Actuator',
    'ControlAffineSystem',
    'DerivativeSamples',
    'EquilibriumError',
    'ExactLift',
    'Excitation',
    'ExcitationError',
    'FloatArray',
    'IntegrationError',
    'IntegrationFailure',
    'IntegratorSettings',
    'Process',
    'RandomStepDesign',
    'ReactorParameters',
    'Trajectory',
    'advance',
    'eigenvalues',
    'equilibrium',
    'equilibrium_input',
    'fold',
    'in_steps',
    'one_state_reactor',
    'random_steps',
    'sample_derivatives',
    'scalar_exact_lift',
    'scalar_example',
    'sensor_noise',
    'simulate',
    'simulate_many',
    'two_state_exact_lift',
    'two_state_example',
    'two_state_reactor',
    'with_input_lag',
]
