# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A record of a plant, read from tables and bags into episodes with names and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
import os
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import numpy as np

from koopman_ros.core.arrays import expect, short_repr, show_printed
from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.message_fields import base_name, place, SIGNAL_NAME
from koopman_ros.core.signals import check_text
from koopman_ros.core.units import check_unit, NANOSECONDS
from koopman_ros.records.episodes import stream_episodes
from koopman_ros.records.import_spec import ImportReport, RecordedInput, RecordedState
from koopman_ros.records.table_import import conversion_of, import_table
from koopman_ros.records.tables import SignalColumn, Source, table_of

#: Names of signals: ``'level'``, ``'level [m]'``, ``'level = LT101.PV [m]'``.
Names: TypeAlias = str | Sequence[str]

_BAGS = ('.mcap', '.db3')


@dataclass(frozen=True)
class Record:
    """
    Measurements of a plant, with the names and units of its signals.

    It is made by :func:`read`:

    >>> record = read('log.csv', 'level', 'pump')
    >>> record.plant.state_units, len(record.episodes)
    (('m',), 1)
    """

    plant: PlantDescription  #: its nominal point is NaN and its B None, as they are not known yet
    episodes: tuple[Episode, ...]  #: times in s since the first measurement of each
    report: ImportReport  #: counts of measurements used and dropped, and notes
    sources: tuple[str, ...]  #: names of the files

    __repr__ = short_repr
    _repr_pretty_ = show_printed

    def __iter__(self) -> NoReturn:
        raise TypeError('a record is not a sequence: give its record.episodes')

    def of(self, states: Mapping[str, str], inputs: Mapping[str, str]) -> Record:
        """
        Return the record with some signals alone, in their order and units.

        :param states: units of the states by name.
        :param inputs: units of the inputs by name.
        :raises ValueError: for a signal that the record does not have, or a unit of another kind.
        """
        expect(states=(states, Mapping), inputs=(inputs, Mapping))
        about, taken = self.plant, []
        for kind, wanted, names, units in (
                ('state', states, about.state_names, about.state_units),
                ('input', inputs, about.input_names, about.input_units)):
            if missing := [name for name in wanted if name not in names]:
                raise ValueError(f'the record has no {kind} {missing[0]}, it has '
                                 f'{", ".join(names)}: name one of them')
            columns = [names.index(name) for name in wanted]
            taken.append((columns, [conversion_of(name, units[j], unit) for j, (name, unit) in zip(
                columns, wanted.items(), strict=True)]))
        (of_x, in_x), (of_u, in_u) = taken
        return replace(self, plant=replace(
            about, state_names=tuple(states), state_units=tuple(states.values()),
            input_names=tuple(inputs), input_units=tuple(inputs.values()), B=None,
            nominal_state=np.full(len(states), np.nan), nominal_input=np.full(len(inputs), np.nan),
        ), episodes=tuple(replace(
            one, x=np.column_stack([to(one.x[:, j]) for j, to in zip(of_x, in_x, strict=True)]),
            u=np.column_stack([to(one.u[:, j]) for j, to in zip(of_u, in_u, strict=True)]),
            linear=tuple(one.linear[j] for j in of_u) if one.linear else ())
            for one in self.episodes))

    def __str__(self) -> str:
        """Show the signals, the episodes and the report."""
        about = self.plant
        signals = ', '.join(f'{name} [{unit}]' for name, unit in zip(
            (*about.state_names, *about.input_names), (*about.state_units, *about.input_units),
            strict=True))
        lengths = [f'{len(one)} samples in {one.time[-1]:.6g} s' for one in self.episodes]
        return '\n  '.join([signals, *lengths, *self.report.lines()])


def read(source: Source, states: Names, inputs: Names, *, time: str = '', period: float = 0.0,
         linear: Names = (), tolerance: float = 0.0, name: str = '',
         dayfirst: bool | None = None) -> Record:
    """
    Read a record of a plant from tables or bags.

    A signal is the column of its name, with the unit in the header or in the argument:

    >>> record = read('log.csv', states='level', inputs='pump')          # level [m], pump [V]
    >>> record = read({'t [min]': list(range(20)), 'TI1 [degC]': 20 * [20.0],
    ...                'HC12.OUT': 20 * [50.0]},
    ...               ['temperature = TI1 [K]'], ['heater = HC12.OUT [percent]'], time='t')
    >>> record.episodes[0].time[:2].tolist(), record.episodes[0].x[0].tolist()
    ([0.0, 60.0], [293.15])

    Where both have a unit, values are converted to that of the argument. A signal without a unit
    has the unit 1. A cell without a number is a missing measurement of that signal alone: NaN in
    the episodes, so that a signal from the laboratory counts at its own times. An input without a
    number keeps its last value. A column ``level_quality``, or ``quality`` for all, of texts or
    codes of OPC, leaves out the values that are not good. A new episode begins at a gap of 3.5
    usual periods, where time is set back, and where a state jumps as after a reset; spikes are
    dropped.

    :param source: a text table (.csv, .txt, .tsv, .dat, .lvm), a .parquet or .mat file, a bag, a
        DataFrame, columns by name, or a list of them. Columns of a two-dimensional array y of a
        .mat file are y_1, y_2 and so on.
    :param states: measured signals, ``name``, ``name [unit]`` or ``name = column [unit]``.
    :param inputs: inputs that acted from the time of their row on. In a bag, an input is its
        commands and its measurements, on the usual topics of its name.
    :param time: column of the time, by default ``time`` or an index of dates. Dates and durations
        are recognised, and times of a day in a column ``date``; numbers are seconds, since 1970
        too, or of the unit in the header or below: ns, us, ms, s, min, h, d.
    :param period: time between rows in s, in place of a column.
    :param linear: inputs that are linear from row to row, such as measurements of a slow actuator.
    :param tolerance: largest difference in s between the stamps of one sample in a bag.
    :param name: of the plant; by default that of the first file.
    :param dayfirst: whether 1/2/2026 is 1 February, where the dates of the column leave it open.
    :raises BagReadError: for a bag that cannot be read.
    :raises ValueError: for a table that cannot be read, or whose times or numbers have more than
        one reading, with row, column and cell.
    :raises TypeError: for an argument of another type, as where they are in another order.
    """
    _check_options(time=(time, str, 'the name of a column'), name=(name, str, 'a text'),
                   period=(period, Real, 'a number of s'),
                   tolerance=(tolerance, Real, 'a number of s'),
                   dayfirst=(dayfirst, bool | None, 'True, False or None'))
    sources = source if isinstance(source, list | tuple) else [source]
    if not sources:
        raise ValueError('the list of files and tables is empty: give at least one')
    if not tolerance >= 0.0:
        raise ValueError(f'tolerance = {tolerance} s must be at least 0 s')
    of_states, of_inputs = (tuple(map(SignalColumn.of, _names(some, role)))
                            for some, role in ((states, 'states'), (inputs, 'inputs')))
    _check_names(of_states, of_inputs, _names(linear, 'linear'))
    report = ImportReport()
    episodes: list[Episode] = []
    for number, one in enumerate(sources):
        label = os.fspath(one) if isinstance(one, str | os.PathLike) else f'table {number + 1}'
        if _is_bag(one):
            episodes += stream_episodes(
                [one], list(map(_recorded_state, of_states)),
                list(map(_recorded_input, of_inputs)), report,
                tolerance_ns=round(tolerance * NANOSECONDS))
            continue
        table = table_of(one, label).with_tags((*of_states, *of_inputs), time)
        of_states, of_inputs = (tuple(signal.with_unit_in(table, report) for signal in some)
                                for some in (of_states, of_inputs))
        episodes += import_table(table, table.seconds(time, period, dayfirst, report.note),
                                 of_states, of_inputs, _names(linear, 'linear'), report)
    report.dropped = +report.dropped
    files = tuple(os.fspath(one) for one in sources if isinstance(one, str | os.PathLike))
    name = name or Path(files[0] if files else 'plant').stem
    check_text('the name of the plant', name)
    if not episodes:
        raise ValueError('the record holds no usable segment of measurements: '
                         + '; '.join(report.lines()))
    plant = PlantDescription(
        name, tuple(one.name for one in of_states), tuple(one.unit for one in of_states),
        tuple(one.name for one in of_inputs), tuple(one.unit for one in of_inputs),
        's', np.full(len(of_states), np.nan), np.full(len(of_inputs), np.nan), None)
    return Record(plant, tuple(episodes), report, files)


def _check_options(**given: tuple[object, Any, str]) -> None:
    for name, (value, kind, words) in given.items():
        if not isinstance(value, kind):
            raise TypeError(f'{name} must be {words}, got {value!r}')


def _names(names: Names, argument: str) -> list[str]:
    if not isinstance(names, str) and np.ndim(names) != 1:
        raise TypeError(f'{argument} must be a name or a list of names, got a '
                        f'{type(names).__name__}: the file or table is the first argument of '
                        'read(source, states, inputs)')
    found = [names] if isinstance(names, str) else list(names)
    if wrong := [one for one in found if not isinstance(one, str)]:
        raise TypeError(f'{argument} must be names of columns, got {wrong[0]!r}')
    return found


def _check_names(states: Sequence[SignalColumn], inputs: Sequence[SignalColumn],
                 linear: Sequence[str]) -> None:
    every = [one.name for one in (*states, *inputs)]
    if not (states and inputs):
        raise ValueError('a record has states and inputs: name at least one of each')
    if wrong := [name for name in every if not SIGNAL_NAME.fullmatch(name)]:
        raise ValueError(f'{wrong[0]!r} cannot be the name of a signal, which has letters, digits '
                         'and _ and begins with a letter: name it, as in '
                         f"'level = {wrong[0]}'")
    if repeated := [name for name in every if every.count(name) > 1]:
        raise ValueError(f'{repeated[0]} is named twice: give each signal once')
    if unknown := [name for name in linear if name not in every[len(states):]]:
        raise ValueError(f'linear names {unknown[0]}, which is not an input: choose from '
                         f'{", ".join(every[len(states):])}')


def _is_bag(source: Source) -> bool:
    return isinstance(source, str | os.PathLike) and (
        Path(source).is_dir() or Path(source).suffix in _BAGS)


def _recorded_state(signal: SignalColumn) -> RecordedState:
    unit = _unit_in_bag(signal)
    return RecordedState(signal.name, unit, place(f'/{signal.column}', signal.name, unit))


def _recorded_input(signal: SignalColumn) -> RecordedInput:
    unit = _unit_in_bag(signal)
    command = f'/{base_name(signal.column, unit)}_setpoint'
    return RecordedInput(signal.name, unit, place(command, signal.name, unit),
                         place(f'/{signal.column}', signal.name, unit))


def _unit_in_bag(signal: SignalColumn) -> str:
    if not signal.unit:
        raise ValueError(f"{signal.name} has no unit, and a bag stores none: write '{signal.name} "
                         "[m]', or [1] if it is dimensionless")
    check_unit(signal.unit)
    return signal.unit
