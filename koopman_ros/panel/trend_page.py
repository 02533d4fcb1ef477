# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Trends of all signals: a page of its own, and a chart that other pages have, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
import time
from typing import Any

from nicegui import ui
from nicegui.events import GenericEventArguments
import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.panel.frame import div, Frame, words
from koopman_ros.panel.plant import Face, InputFace, pen, Range, Snapshot
from koopman_ros.panel.trends import Mark

SPANS = {'10 min': (600.0, 1.0), '1 h': (3600.0, 2.0), '8 h': (28800.0, 5.0)}  #: and the renewal
_BUCKETS = 500
_ALL: Range = (0.0, 1.0)  # shares of the time shown
_PAUSE = 0.3  # s between two looks at a window that is being zoomed
_EPOCH = 1e9  # s; what is later is a time of day, what is earlier one of a simulation
_MARKS = 40  # that are shown, the last ones
_INKS = ('#1d1d1b', '#4b6a88', '#7a6a45', '#6b4b6b', '#3f6b54', '#8a5a44')
_LINES = {'measured': ('solid', 2.0), 'active_setpoints': ('dashed', 1.6),
          'predicted': ('dotted', 1.2), 'planned': ('dotted', 1.6), 'commands': ('solid', 2.0)}
_ABNORMAL = '#8a4b00'
# in the browser
_CLOCK = 'p => new Date(p.value).toTimeString().slice(0, 8)'
_PLANT_CLOCK = 'p => new Date(p.value).toISOString().slice(11, 19)'
_QUIET = '#6b6b67'


@dataclass(frozen=True)
class _Pen:
    kind: str
    face: Face

    @property
    def key(self) -> str:
        return pen(self.kind, self.face.name)

    @property
    def title(self) -> str:
        return f'{pen(self.kind, self.face.label)} [{self.face.unit}]'


def _charts(now: Snapshot) -> list[tuple[str, list[_Pen]]]:
    """Return the unit and the pens of each chart: of the states, and of the inputs."""
    found: dict[tuple[str, str], list[_Pen]] = {}
    for state in now.states:
        kinds = ('measured', 'active_setpoints', 'predicted', 'planned') if (
            state.controlled) else ('measured', 'predicted')
        found.setdefault(('states', state.unit), []).extend(_Pen(kind, state) for kind in kinds)
    for own in now.inputs:
        found.setdefault(('inputs', own.unit), []).extend(
            _Pen(kind, own) for kind in ('commands', 'applied', 'planned'))
    return [(unit, pens) for (_, unit), pens in found.items()]


class TrendChart:
    """
    The pens of a plant over time, renewed by itself.

    :param height: of the chart of one unit, in pixels.
    :param zoom: whether there is a bar by which it is zoomed.
    """

    def __init__(self, frame: Frame, height: int, *, zoom: bool) -> None:
        self._frame = frame
        self._charts = _charts(frame.source.snapshot)
        self.span, self.whole = '10 min', False
        self._due = 0.0
        self._zoomed = _ALL
        self.happened: Sequence[Mark] = ()  #: what is marked
        room = 90 if zoom else 45
        # what has no time yet may be either
        simulated = frame.source.snapshot.time < _EPOCH
        self._chart = ui.echart(_frame_of(self._charts, height, zoom, simulated)).props(
            'aria-label="Trends of all signals" role=img')
        self._chart.style['height'] = f'{height * len(self._charts) + room}px'
        if zoom:
            self._chart.on('chart:datazoom', self._on_zoom, ['start', 'end', 'batch'],
                           throttle=_PAUSE, leading_events=False)

    def show(self, span: str, whole: bool) -> None:
        """Show another time, and the whole range of each signal or what is drawn of it."""
        self.span, self.whole, self._due = span, whole, 0.0
        self.renew()

    def _on_zoom(self, event: GenericEventArguments) -> None:
        """Draw what a zoomed window shows as finely as the whole was."""
        if (shares := zoomed(event.args)) is not None and shares != self._zoomed:
            self._zoomed, self._due = shares, 0.0
            self.renew()

    def renew(self) -> None:
        """Draw what is new, where it is time."""
        length, period = SPANS[self.span]
        trends = self._frame.source.view.trends
        if time.monotonic() < self._due or (latest := trends.latest) is None:
            return
        self._due = time.monotonic() + period
        now, charts = self._frame.source.snapshot, self._charts
        begin = latest - length
        if latest < _EPOCH:
            # a simulation has no time before its own
            begin = max(begin, 0.0)
        end = min(ahead(now, latest), latest + length)
        keys = [own.key for _, pens in charts for own in pens]
        found = trends.window(keys, begin, latest, _BUCKETS)
        if self._zoomed != _ALL:
            first, last = (begin + share * (end - begin) for share in self._zoomed)
            fine = trends.window(keys, first, last, _BUCKETS)
            found = {key: _refined(found[key], fine[key]) for key in keys}
        self.happened = trends.marks(begin, latest)[-_MARKS:]
        self._chart.run_chart_method('setOption', {
            'useUTC': latest < _EPOCH,
            # of a law that does not plan there is no line
            'legend': {'data': [own.title for _, pens in charts for own in pens
                                if own.kind != 'planned' or _present(own.face, now).plan]},
            'xAxis': [{'min': 1e3 * begin, 'max': 1e3 * end} for _ in charts],
            'yAxis': [_ends(pens, now) if self.whole else {'min': None, 'max': None}
                      for _, pens in charts],
            'series': [{'name': own.title, 'data': (
                _planned(own, now) if own.kind == 'planned' else _points(*found[own.key])),
                        'markLine': _lines(number == 0, own, now, self.happened)}
                       for _, pens in charts for number, own in enumerate(pens)]})


def ahead(now: Snapshot, latest: float) -> float:
    """Return until when there is something to draw: the last value, or the end of a plan."""
    return max([latest, *(face.plan[-1][0] for face in (*now.states, *now.inputs) if face.plan)])


def zoomed(told: Any) -> Range | None:
    """Return where a window begins and ends, as shares, of what a browser says of it."""
    try:
        batch = told.get('batch')
        one = batch[0] if batch else told
        first, last = float(one['start']) / 100.0, float(one['end']) / 100.0
    except (AttributeError, LookupError, TypeError, ValueError):
        return None
    return (first, last) if 0.0 <= first < last <= 1.0 else None


def _refined(whole: tuple[Array, Array], fine: tuple[Array, Array]) -> tuple[Array, Array]:
    """Put a part of a pen that has more values in place of that part of the whole."""
    times, values = whole
    if not len(fine[0]):
        return whole
    before, behind = times < fine[0][0], times > fine[0][-1]
    return (np.concatenate((times[before], fine[0], times[behind])),
            np.concatenate((values[before], fine[1], values[behind])))


def trend_page(frame: Frame) -> None:
    """Build the page."""
    with frame.body:
        with div('row1 middle'):
            span = ui.toggle(list(SPANS), value='10 min').props(
                'aria-label="Time shown" unelevated color=grey-5 text-color=black '
                'toggle-color=grey-9')
            whole = ui.checkbox('whole range')
            words('span', 'wheel or two fingers zoom, dragging moves; the cursor reads all pens',
                  'quiet')
        chart = TrendChart(frame, 260, zoom=True)
        words('h2', 'What happened')
        marks = div('card journal').props('role=list aria-label=Marks')
    shown: list[Any] = [None]

    def show(_: Snapshot) -> None:
        chart.renew()
        if shown[0] == chart.happened:
            return
        shown[0] = chart.happened
        marks.clear()
        with marks:
            for mark in reversed(chart.happened):
                words('div', f'{_moment(mark.time)}  {mark.kind}: {mark.text}').props(
                    'role=listitem')
            if not chart.happened:
                words('div', 'nothing in this time', 'quiet')

    for control in (span, whole):
        # a browser may send any value
        control.on_value_change(lambda _: chart.show(str(span.value), bool(whole.value)) if (
            span.value in SPANS) else None)
    frame.follow(show)


def _moment(seconds: float) -> str:
    moment = time.gmtime(seconds) if seconds < _EPOCH else time.localtime(seconds)
    return time.strftime('%H:%M:%S', moment)


def _points(times: Array, values: Array) -> list[list[float | None]]:
    return [[1e3 * t, round(v, 6) if math.isfinite(v) else None]
            for t, v in zip(times.tolist(), values.tolist(), strict=True)]


def _planned(own: _Pen, now: Snapshot) -> list[list[float | None]]:
    times, values = np.reshape(_present(own.face, now).plan, (-1, 2)).T
    return _points(times, values)


def _present(face: Face, now: Snapshot) -> Face:
    return next(own for own in (*now.states, *now.inputs) if own.name == face.name)


def _ends(pens: Sequence[_Pen], now: Snapshot) -> dict[str, float]:
    spans = [_present(own.face, now).span for own in pens]
    return {'min': round(min(low for low, _ in spans), 6),
            'max': round(max(high for _, high in spans), 6)}


def _lines(first: bool, own: _Pen, now: Snapshot, happened: Sequence[Mark]) -> dict[str, Any]:
    """Return the limits of a signal as level lines, and events as upright ones."""
    found: list[dict[str, Any]] = []
    face = _present(own.face, now)
    if own.kind in ('measured', 'commands'):
        ranges: list[tuple[str, Range | None]] = [('trained', face.training),
                                                  ('limit', face.limits)]
        found += [{'yAxis': end, 'name': what} for what, bounds in ranges if bounds
                  # the chart fails at one that is not finite
                  for end in bounds if math.isfinite(end)]
    if first:
        found += [{'xAxis': 1e3 * mark.time, 'name': mark.kind, 'lineStyle': {
            'type': 'solid', 'color': _ABNORMAL if mark.kind == 'alarm' else _QUIET}}
            for mark in happened]
    return {'symbol': 'none', 'silent': True, 'animation': False, 'data': found,
            'lineStyle': {'type': 'dashed', 'color': '#8a8a86'},
            'label': {'formatter': '{b}', 'position': 'insideEndTop', 'fontSize': 10,
                      'color': '#4d4d4a'}}


def _frame_of(charts: list[tuple[str, list[_Pen]]], height: int, zoom: bool, simulated: bool
              ) -> dict[str, Any]:
    """Return charts without data, one above the other."""
    several = range(len(charts))
    pens = [(at, own) for at, (_, own_pens) in enumerate(charts) for own in own_pens]
    grey = {'borderColor': '#a9a9a5', 'fillerColor': 'rgba(90,90,86,.25)',
            'handleStyle': {'color': '#4d4d4a', 'borderColor': '#4d4d4a'},
            'moveHandleStyle': {'color': '#8a8a86'}, 'brushSelect': False,
            'emphasis': {'handleStyle': {'color': '#1d1d1b'},
                         'moveHandleStyle': {'color': '#4d4d4a'}}}
    return {
        'animation': False, 'backgroundColor': 'transparent',
        'textStyle': {'color': '#1d1d1b', 'fontSize': 13},
        'axisPointer': {'link': [{'xAxisIndex': 'all'}]},
        # drawn: the usual one is HTML
        'tooltip': {'trigger': 'axis', 'renderMode': 'richText', 'confine': True,
                    'transitionDuration': 0,
                    ':valueFormatter': "v => v == null ? '–' : (+v).toPrecision(6)",
                    'axisPointer': {'type': 'cross', 'label': {'backgroundColor': '#4d4d4a'}}},
        'legend': {'type': 'scroll', 'top': 4, 'pageIconColor': '#4d4d4a',
                   'data': [own.title for _, own in pens if own.kind != 'planned'],
                   'textStyle': {'color': '#1d1d1b', 'fontSize': 13}, 'icon': 'roundRect',
                   # less than that of the text cuts it where there are several pages of pens
                   'itemHeight': 14, 'itemWidth': 14},
        'grid': [{'left': 56, 'right': 16, 'top': 45 + height * at, 'height': height - 60}
                 for at in several],
        'xAxis': [{'type': 'time', 'gridIndex': at, 'axisPointer': {'label': {
            ':formatter': _CLOCK if not simulated else _PLANT_CLOCK}}, 'axisLabel': {
            'formatter': '{HH}:{mm}:{ss}', 'hideOverlap': True, 'color': '#1d1d1b'}}
            for at in several],
        'yAxis': [{'type': 'value', 'scale': True, 'gridIndex': at, 'name': unit,
                   'axisLabel': {'color': '#1d1d1b'}, 'nameTextStyle': {'color': '#1d1d1b'},
                   'splitLine': {'lineStyle': {'color': '#c4c4c0'}}}
                  for at, (unit, _) in enumerate(charts)],
        'dataZoom': [] if not zoom else [
            {'type': 'inside', 'xAxisIndex': list(several), 'filterMode': 'none'},
            {'type': 'slider', 'xAxisIndex': list(several), 'bottom': 6, 'height': 24,
             'filterMode': 'none', 'showDataShadow': False, 'labelFormatter': '', **grey}],
        'series': [{'type': 'line', 'name': own.title, 'showSymbol': False,
                    'xAxisIndex': at, 'yAxisIndex': at, 'data': [],
                    'step': 'end' if own.kind in ('commands', 'active_setpoints') or (
                        own.kind == 'planned' and isinstance(own.face, InputFace)) else False,
                    'color': _INKS[number % len(_INKS)],
                    'lineStyle': dict(zip(('type', 'width'), _LINES.get(
                        own.kind, ('dashed', 1.2)), strict=True))}
                   for number, (at, own) in enumerate(pens)]}
