# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the trainer node, which records bags and trains models from them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from koopman_ros.control.experiment import Experiment
from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import (
    column,
    NO_LOWER,
    NO_UPPER,
    parameter,
    per_signal,
    plugin_parameters,
    UNBOUNDED,
    value_column,
)
from koopman_ros.core.plugins import short_name
from koopman_ros.core.units import conversion, display_unit
from koopman_ros.model_classes import BEST, CLASSES, SAME
from koopman_ros.parameters.equations import named_ranges
from koopman_ros.parameters.signal_topics import (
    DEFAULT_SYSTEM,
    InputPlaces,
    MeasuredPlace,
    Signals,
    StatePlaces,
)

COMMAND, MANUAL, SETPOINT = 'command', 'manual', 'setpoint'


@dataclass(frozen=True)
class TrainedInput(InputPlaces):
    """The same with its effect."""

    characteristic: tuple[float, ...] = parameter(
        (0.0,), 'Static characteristic: values of the input and their effects in turn, e.g. [0, '
        '0, 50, 20, 100, 100]; the effects may have any unit; two points: linear; a single 0: '
        'found from the record.')
    as_state: bool = parameter(
        False, 'Make the command a state of the model, whose rate the laws set: for an effect on '
        'the rates that is neither linear nor that of a characteristic. All states must be '
        'measured.')


@dataclass(frozen=True, eq=False)
class SignalParameters:
    """The signals of a plant, as parameters name them."""

    system: str = parameter(
        DEFAULT_SYSTEM, 'Bundled plant whose signals, topics and limits are the defaults; any '
        'other name: no defaults.', read_only=True)
    states_measured: tuple[str, ...] = parameter(
        ('',), 'Measured signals with their units, e.g. level [m]; an empty name: those of the '
        'model.', read_only=True)
    inputs_commanded: tuple[str, ...] = parameter(
        ('',), 'Inputs with their units, e.g. pump [V]; an empty name: those of the model.',
        read_only=True)
    disturbances_measured: tuple[str, ...] = parameter(
        ('',), 'Measured disturbances with their units: signals that act on the plant but are not '
        'manipulated, e.g. feed_temperature [K]; an empty name: those of the model, or none.',
        read_only=True)
    controlled: tuple[str, ...] = parameter(
        ('',), 'Measured signals with a set-point; an empty name: all.', read_only=True)


@dataclass(frozen=True, eq=False)
class TrainerParameters(SignalParameters):
    """Snapshot of the trainer's parameters, in the units that people read."""

    autostart: bool = parameter(
        True, 'Configure and activate at start-up; false: left to a lifecycle manager.',
        read_only=True)
    task: str = parameter(
        'record', 'record: run as a node that records, runs experiments and trains on request; '
                  'train: train from the bags, then '
                  'exit.', choices=('record', 'train'), read_only=True)
    record_at_start: bool = parameter(
        True, 'Start recording at start-up, without waiting for ~/record.', read_only=True)
    output: str = parameter(
        '', 'Bag to record: a file ending in .mcap or a new folder; empty: a folder named after '
            'date and time. Existing bags are kept: if run exists, run_2 is written.')
    topics: tuple[str, ...] = parameter(
        ('',), 'Topics to record. Those outside the loop are subscribed when a publisher appears.')
    compression: str = parameter(
        'none', 'Compression of the bag. Uncompressed bags can be read even when damaged.',
        choices=('none', 'zstd', 'lz4'))
    max_bag_size: float = parameter(
        0.0, 'File size at which the recording continues in the next file of the folder; 0: '
        'one file.', 'MB', 0.0, 1e9, smallest=1e-6)
    max_bag_duration: float = parameter(
        0.0, 'Duration after which the recording continues in the next file of the folder; 0: '
        'one file.', 's', 0.0, 1e9, smallest=1e-6)
    min_free_disk: float = parameter(
        100.0, 'Free disk space below which recording does not start, or stops.', 'MB',
        0.0, 1e12)
    experiment_signal: str = parameter(
        COMMAND, 'Signals that the experiment steps: the commands of the plant, the manual '
        'commands of a controller in manual mode, or the set-points of a controller in automatic '
        'mode.', choices=(COMMAND, MANUAL, SETPOINT))
    experiment_length: float = parameter(
        3600.0, 'Duration of the experiment.', 's', 0.0, 1e6, open_minimum=True)
    experiment_min_hold_time: float = parameter(30.0, 'Shortest step.', 's', 0.01, 1e6)
    experiment_max_hold_time: float = parameter(120.0, 'Longest step.', 's', 0.01, 1e6)
    experiment_timeout: float = parameter(
        10.0, 'Wall time without a newer measurement after which the experiment is aborted.', 's',
        0.0, 86400.0, open_minimum=True)
    experiment_seed: int = parameter(
        0, 'Random seed of the steps.', '', 0, 2 ** 31)
    bags: tuple[str, ...] = parameter(
        ('',), 'Training data: .mcap files or bag folders; an empty name: the bag recorded by '
               'this trainer.')
    model: str = parameter(
        '', 'Current model, which a new one must beat: name of a bundled model, or path of a '
            '.safetensors file; empty: train a first model.')
    model_output: str = parameter(
        'retrained.safetensors', 'File for an accepted model; the file that it replaces is kept '
                                 'as .previous.safetensors.')
    model_class: str = parameter(
        SAME, 'Class of the new model; best: train all of them and select one by comparison; '
        'same: that of model, or best if model is empty.', choices=(*CLASSES, BEST, SAME))
    lifted_dimension: int = parameter(
        0, 'Number of lifted coordinates n_z of a new identity lift; 0: two more than states.', '',
        0, 8, smallest=2)
    restarts: int = parameter(
        3, 'Random restarts per coordinate; the best is kept.', '', 1, 100)
    training_seed: int = parameter(
        0, 'Random seed of the training, of the choice of held-out data, and of the thinning of '
           'long records.', '', 0, 2 ** 31)
    training_samples: int = parameter(
        20_000, 'Largest number of samples for training and testing. Longer records are averaged '
                'where no information is lost, then thinned to segments that cover their '
                'range.', '', 1000,
        1_000_000)
    warm_start_model: str = parameter(
        '', 'Model of a similar plant from which the training starts: a bundled model by name, or '
        'the path of a model file; empty: none.')
    executor: str = parameter(
        '', 'Back end of the training. Empty: one process; joblib: one process per core; '
            'joblib:N: N processes; tcp://host:port: the workers of a Dask '
            'scheduler.', read_only=True)
    device: str = parameter(
        'cpu', 'Device that evaluates the residuals on every worker: cpu, or a torch device, e.g. '
               'cuda.')
    input_matrix: tuple[float, ...] = parameter(
        (0.0,), 'Known input matrix B, row by row: change of the rate of each state, in its unit '
        'per second, for each input and measured disturbance; a single 0: learn it.')
    input_matrix_degree: int = parameter(
        0, 'Degree of a learned B(x) as a polynomial in the states; 0: constant B, the only one '
        'with measured disturbances; with unmeasured_states -1 also degree 1 if the record shows '
        'it.', '', 0, 5)
    identification_methods: tuple[str, ...] = parameter(
        ('weak_form', 'total_variation'), 'Methods that estimate the drift if all states are '
                                          'measured, compared on held-out segments: weak_form, '
                                          'total_variation, or module:Class.', code=True)
    methods: Mapping[str, Any] = plugin_parameters()
    unmeasured_states: int = parameter(
        0, 'Largest number of unmeasured states to estimate with the model; 0: all states are '
        'measured; -1: as many as a simulation of the record needs, up to 3, if model and '
        'physical_model are empty and B is constant.', '', -1, 4)
    physical_model: str = parameter(
        '', 'Plant whose equations are fitted in place of a black-box drift: a plant of the '
        'library, an entry point of the group koopman_ros.plants, or package.module:Class; empty: '
        'none.', code=True)
    estimated_constants: tuple[str, ...] = parameter(
        ('',), 'Constants of the equations to estimate, with ranges in SI units, e.g. friction '
               '[0.01, 0.5]. Without a range: that of the class. An empty name: the constants '
               'that the class marks as estimated.')
    synchronisation_tolerance: float = parameter(
        0.0, 'Largest difference between the stamps of messages that belong to one '
             'measurement.', 's',
        0.0, 10.0)
    acceptance_margin: float = parameter(
        0.1, 'A new model is accepted if its held-out error is smaller than that of the current '
             'model and of the best linear model by at least this fraction.', '', 0.0, 0.99)
    max_condition_number: float = parameter(
        1e4, 'Largest accepted condition number of learned coordinates, over that of the states '
             'among them.', '', 1.0, 1e12, open_minimum=True)

    states: Mapping[str, StatePlaces] = per_signal(StatePlaces)
    measured_min: Array = value_column(
        'states', -UNBOUNDED, 'Measurement below which the experiment is aborted.',
        name='experiment_min', none=NO_LOWER)
    measured_max: Array = value_column(
        'states', UNBOUNDED, 'Measurement above which the experiment is aborted.',
        name='experiment_max', none=NO_UPPER)
    setpoint_min: Array = value_column(
        'states', 0.0, 'Lowest set-point of an experiment on set-points.')
    setpoint_max: Array = value_column(
        'states', 0.0, 'Highest set-point of an experiment on set-points.')
    inputs: Mapping[str, TrainedInput] = per_signal(TrainedInput)
    disturbances: Mapping[str, MeasuredPlace] = per_signal(MeasuredPlace)
    experiment_min: Array = value_column('inputs', 0.0, 'Lowest value of a step.')
    experiment_max: Array = value_column('inputs', 0.0, 'Highest value of a step.')
    experiment_rate_limit: Array = column(
        'inputs', 0.0, 'Rate limit during the experiment; 0: none.', '{unit}/s', 0.0, 1e9)
    safe_value: Array = value_column(
        'inputs', 0.0, 'Safe value, at which the experiment starts and ends.')
    delay: Array = column(
        'inputs', 0.0, 'Delay between a command and its application, where that is not recorded.',
        's', 0.0, 3600.0)
    dead_time: Array = column(
        'inputs', -1.0, 'Dead time between the applied input and its effect; -1: found from the '
        'record.', 's', -1.0, 3600.0)
    lag: Array = column(
        'inputs', 0.0, 'Time constant with which the applied input follows the command, and is a '
        'state of the model; -1: found from a record of all other states; 0: none.', 's', -1.0,
        3600.0)

    def experiment(self, signals: Signals, setpoints: Array | None = None) -> Experiment:
        """
        Return the plan of an experiment; a ValueError names the missing parameters.

        :param setpoints: (n_c,) to come back to, for one that steps these; None steps the inputs.
        """
        on_setpoints = setpoints is not None
        if missing := self.missing(signals, on_setpoints):
            raise ValueError('the bounds of the experiment are unknown: set '
                             + ', '.join(missing))
        names, lower, upper = self._steps(signals, on_setpoints)
        rate = np.zeros(len(names)) if on_setpoints else self.experiment_rate_limit
        return Experiment(
            duration=self.experiment_length, names=names, lower=lower, upper=upper,
            rate=np.where(rate > 0.0, rate, UNBOUNDED),
            home=self.safe_value if setpoints is None else setpoints,
            hold_shortest=self.experiment_min_hold_time,
            hold_longest=self.experiment_max_hold_time, measured=tuple(signals.states),
            measured_lower=self.measured_min, measured_upper=self.measured_max,
            seed=self.experiment_seed)

    def _steps(self, signals: Signals, on_setpoints: bool) -> tuple[tuple[str, ...], Array, Array]:
        """Return names, lowest and highest values of the signals that are stepped."""
        if not on_setpoints:
            return tuple(signals.inputs), self.experiment_min, self.experiment_max
        rows = [list(signals.states).index(name) for name in signals.controlled]
        return signals.controlled, self.setpoint_min[rows], self.setpoint_max[rows]

    def missing(self, signals: Signals, on_setpoints: bool = False) -> list[str]:
        """Return the parameters without which there is no experiment, with their units."""
        what = 'setpoint' if on_setpoints else 'experiment'
        steps = zip(*self._steps(signals, on_setpoints), strict=True)
        bounds = zip(signals.states, self.measured_min, self.measured_max, strict=True)
        rows = [*((name, f'{what}_{end}') for name, low, high in steps if low == high
                  for end in ('min', 'max')),
                *((name, f'experiment_{end}') for name, low, high in bounds
                  for end, bound in (('min', low), ('max', high)) if np.isinf(bound))]
        return [f'{name}.{row} [{display_unit(signals.units[name])}]' for name, row in rows]

    def setpoint_ranges(self, signals: Signals) -> dict[str, tuple[float, float]]:
        """Return the lowest and highest set-point of states that have a range, in their units."""
        names, lows, highs = self._steps(signals, on_setpoints=True)
        return {name: (low, high) for name, low, high in zip(
            names, lows.tolist(), highs.tolist(), strict=True) if low < high}

    def training(self, signals: Signals) -> dict[str, Any]:
        """Return the fields of a :class:`koopman_ros.learning.TrainingTask` that are settings."""
        columns = (*signals.inputs, *signals.disturbances)
        gains = np.reshape(self.input_matrix, (-1, len(columns))).tolist() if (
            self.input_matrix != (0.0,)) else []
        return {'input_gain': {state: dict(zip(columns, row, strict=True))
                               for state, row in zip(signals.states, gains, strict=False)},
                'model_class': self.model_class, 'coordinates': self.lifted_dimension,
                'seed': self.training_seed, 'starts': self.restarts,
                'most_samples': self.training_samples,
                'dead_time': {name: seconds for name, seconds in zip(
                    signals.inputs, self.dead_time.tolist(), strict=True) if seconds >= 0.0},
                'lag': {name: seconds for name, seconds in zip(
                    signals.inputs, self.lag.tolist(), strict=True) if seconds},
                'characteristics': {name: _in_unit(one.characteristic, signals.units[name])
                                    for name, one in self.inputs.items()
                                    if one.characteristic != (0.0,)},
                'as_state': tuple(name for name, one in self.inputs.items() if one.as_state),
                'input_matrix_degree': self.input_matrix_degree,
                'disturbances': tuple(signals.disturbances),
                'unmeasured_states': self.unmeasured_states, 'physical_model': self.physical_model,
                'constants': named_ranges(self.estimated_constants),
                'methods': self.identification_methods,
                'method_parameters': {name: asdict(own) for name, own in self.methods.items()
                                      if name in map(short_name, self.identification_methods)},
                'margin': self.acceptance_margin, 'condition': self.max_condition_number,
                'executor': self.executor, 'device': self.device}


def _in_unit(characteristic: tuple[float, ...], unit: str) -> tuple[float, ...]:
    """Return a characteristic with its values in a unit, from that in which people read it."""
    convert = conversion(display_unit(unit), unit)
    return tuple(one if i % 2 else convert(one) for i, one in enumerate(characteristic))
