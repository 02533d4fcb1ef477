# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Chart of the trends of all signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import colorsys
from dataclasses import dataclass, replace
import math
import time
from typing import Any

from nicegui import ui
from nicegui.events import GenericEventArguments
import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.panel.faceplates import Faceplate, InputFaceplate, pen, Range, StateFaceplate
from koopman_ros.panel.layout import PageLayout
from koopman_ros.panel.snapshot import Snapshot
from koopman_ros.panel.trends import grouped, MarkGroup, TrendMark

#: length and period of the updates in s
SPANS = {'10 min': (600.0, 1.0), '1 h': (3600.0, 2.0), '8 h': (28800.0, 5.0)}
_BUCKETS = 500
_ALL: Range = (0.0, 1.0)  # shares of the time shown
_PAUSE = 0.3  # s between two updates of a zoom
EPOCH = 1e9  #: s; a later stamp is a wall time, an earlier one is a simulated time
_GROUP = 1.0 / 15.0  # of the time shown; nearer events are one mark
_NEAR = 0.06  # of the height of a chart; lines that are nearer have one label
_LEAST = 0.1  # of the range of a signal, which an axis shows
_HEAD, _FOOT = 56, 44  # pixels above and below the plot of a chart
# Pixels for the names of pens in charts from these widths on, as in style.css.
_WIDTHS = {0: 320, 600: 560, 900: 860}
_ROW = 20  # pixels of each further row of names
# width of a line by its kind, and dashes: of the measurements and commands of several signals of
# a chart each has its own, so that they differ without colour
_LINES: dict[str, tuple[float, list[int]]] = {
    'active_setpoints': (1.3, [8, 4]), 'predicted': (1.0, [1, 3]), 'planned': (1.4, [2, 2]),
    'applied': (1.3, [5, 3])}
_DASHES: Sequence[list[int]] = ([], [14, 3], [3, 2], [12, 3, 3, 3], [7, 3, 2, 3, 2, 3])
_ABNORMAL = '#8a4b00'
# clock of trend_page in the browser
_CLOCK = ('t => t >= 1e12 ? new Date(t).toISOString().slice(11, 19) : '
          "String(Math.floor(t / 36e5)).padStart(2, '0') + "
          "new Date(t).toISOString().slice(13, 19)")
_QUIET = '#6b6b67'


@dataclass(frozen=True)
class _Pen:
    kind: str
    signal: str
    key: str  # in the trends
    title: str
    label: str  # of the signal
    steps: bool  # whether the value holds until the next one


_Charts = Sequence[tuple[str, Sequence[_Pen]]]


def _charts(now: Snapshot) -> _Charts:
    """Return the unit and the pens of each chart: of the states, and of the inputs."""
    found: dict[tuple[bool, str], list[_Pen]] = {}
    for face in (*now.states, *now.inputs):
        is_input = isinstance(face, InputFaceplate)
        kinds = ['commands', 'applied', 'planned']
        if isinstance(face, StateFaceplate):
            kinds = ['measured', 'active_setpoints', 'predicted', 'planned'] if (
                face.controlled) else ['measured', *['predicted'] * (not face.disturbance)]
        found.setdefault((is_input, face.unit), []).extend(
            _Pen(kind, face.name, pen(kind, face.name), f'{pen(kind, face.label)} [{face.unit}]',
                 face.label,
                 kind in ('commands', 'active_setpoints') or (kind == 'planned' and is_input))
            for kind in kinds)
    return [(unit, pens) for (_, unit), pens in found.items()]


class TrendChart:
    """
    Chart of all pens over time.

    :param height: of the chart of one unit, in pixels.
    :param zoom: whether it can be zoomed.
    """

    def __init__(self, page: PageLayout, height: int, *, zoom: bool) -> None:
        self._page = page
        self._charts = _charts(page.source.snapshot)
        self._span, self._whole, self._due, self._zoomed = '10 min', False, 0.0, _ALL
        self._end: float | None = None
        self.marks: Sequence[TrendMark] = ()  #: events in the time shown
        self._chart = ui.echart(_options(self._charts, height, zoom)).props(
            'aria-label="Trends of all signals" role=img')
        self._chart.classes('trends').style(';'.join(
            f'--from-{width}: {sum(height + more for more in _rows(self._charts, room)) + 40}px'
            for width, room in _WIDTHS.items()))
        if zoom:
            self._chart.on('chart:datazoom', self._on_zoom, ['start', 'end', 'batch'],
                           throttle=_PAUSE, leading_events=False)

    @property
    def live(self) -> bool:
        """Whether the present is shown."""
        return self._end is None and self._zoomed[1] >= 1.0 - 1e-3

    def reset(self) -> None:
        """Show the whole time again."""
        self._zoomed, self._due = _ALL, 0.0
        self._chart.run_chart_method('dispatchAction', {
            'type': 'dataZoom', 'start': 0, 'end': 100})

    def show(self, span: str, whole: bool, end: float | None) -> None:
        """
        Show another span of time, and the whole range of each signal or that of its values.

        :param end: of the time shown; None to follow the present.
        """
        self._span, self._whole, self._end, self._due = span, whole, end, 0.0
        self.update()

    def _on_zoom(self, event: GenericEventArguments) -> None:
        if (shares := zoomed(event.args)) is not None and shares != self._zoomed:
            self._zoomed, self._due = shares, 0.0
            self.update()

    def update(self) -> None:
        """Draw new values when they are due."""
        length, period = SPANS[self._span]
        trends = self._page.source.view.trends
        if time.monotonic() < self._due or (latest := trends.latest) is None:
            return
        self._due = time.monotonic() + period
        now = self._page.source.snapshot
        faces = {face.name: face for face in (*now.states, *now.inputs)}
        plant_time = latest < EPOCH
        # wall times are those of the panel, wherever the browser is
        zone = 0.0 if plant_time else time.localtime(latest).tm_gmtoff
        end = latest if self._end is None else self._end
        # simulated time begins at 0
        begin = max(end - length, 0.0) if plant_time else end - length
        if self._end is None:
            end = min(plan_end(now, latest), latest + length)
        first, last = (begin + share * (end - begin) for share in self._zoomed)
        pens = [own for _, pens in self._charts for own in pens]
        values = trends.window([own.key for own in pens], begin, end, _BUCKETS)
        if self._zoomed != _ALL:
            # as fine in the zoomed window as in the whole
            fine = trends.window(list(values), first, last, _BUCKETS)
            values = {key: _refined(values[key], fine[key]) for key in values}
        for own in pens:
            if own.kind == 'planned':
                times, plan = np.reshape(faces[own.signal].plan, (-1, 2)).T
                values[own.key] = times, plan
        self.marks = trends.marks(begin, end)
        marks = [replace(mark, time=mark.time + zone) for mark in grouped(
            self.marks, _GROUP * (last - first))]
        self._chart.run_chart_method('setOption', {
            'useUTC': True,
            # without a plan there is no line
            'legend': [{'data': [own.title for own in pens if own.kind != 'planned'
                                 or faces[own.signal].plan]} for _, pens in self._charts],
            'xAxis': [{'min': 1e3 * (begin + zone), 'max': 1e3 * (end + zone),
                       'name': 'plant time' if plant_time else 'wall time'}
                      for _ in self._charts],
            'yAxis': [axis_ends([faces[own.signal].span for own in pens],
                            () if self._whole else [values[own.key][1] for own in pens])
                      for _, pens in self._charts],
            'series': [{'name': own.title,
                        'data': _points(values[own.key][0] + zone, values[own.key][1]),
                        'markLine': {'data': lines if own is chart_pens[0] else []}}
                       for _, chart_pens in self._charts
                       for lines in [_lines(chart_pens, faces, marks)]
                       for own in chart_pens]})


def plan_end(now: Snapshot, latest: float) -> float:
    """Return the last time of the plans, or the latest time without one."""
    return max([latest, *(face.plan[-1][0] for face in (*now.states, *now.inputs) if face.plan)])


def zoomed(event: Any) -> Range | None:
    """Return begin and end of a zoomed window, as shares, from an event of a browser."""
    try:
        batch = event.get('batch')
        one = batch[0] if batch else event
        first, last = float(one['start']) / 100.0, float(one['end']) / 100.0
    except (AttributeError, LookupError, TypeError, ValueError):
        return None
    return (first, last) if 0.0 <= first < last <= 1.0 else None


def _refined(whole: tuple[Array, Array], fine: tuple[Array, Array]) -> tuple[Array, Array]:
    """Replace a part of a pen by the same part with more values."""
    times, values = whole
    if not len(fine[0]):
        return whole
    before, behind = times < fine[0][0], times > fine[0][-1]
    return (np.concatenate((times[before], fine[0], times[behind])),
            np.concatenate((values[before], fine[1], values[behind])))


def _points(times: Array, values: Array) -> list[list[float | None]]:
    return [[1e3 * t, round(v, 6) if math.isfinite(v) else None]
            for t, v in zip(times.tolist(), values.tolist(), strict=True)]


def axis_ends(spans: Sequence[Range], pens: Sequence[Array]) -> dict[str, float | None]:
    """Return the ends of an axis: of the spans without pens, else such that noise stays small."""
    low, high = min(low for low, _ in spans), max(high for _, high in spans)
    if not pens:
        return {'min': round(low, 6), 'max': round(high, 6)}
    least = _LEAST * (high - low)
    values = np.concatenate(pens)
    values = values[np.isfinite(values)]
    if not len(values) or np.ptp(values) >= least:
        # the chart finds round numbers
        return {'min': None, 'max': None}
    middle = 0.5 * float(np.min(values) + np.max(values))
    step = 10.0 ** math.floor(math.log10(least) - 0.5)
    return {'min': round(math.floor((middle - 0.5 * least) / step) * step, 6),
            'max': round(math.ceil((middle + 0.5 * least) / step) * step, 6)}


def _lines(pens: Sequence[_Pen], faces: Mapping[str, Faceplate], marks: Sequence[MarkGroup]
           ) -> list[dict[str, Any]]:
    """Return the limits of the signals of a chart as horizontal lines, and events as vertical."""
    spans = [faces[own.signal].span for own in pens]
    height = max(high for _, high in spans) - min(low for low, _ in spans)
    # the chart fails at an end that is not finite
    ends = sorted((end, own.label, name) for own in pens
                  if own.kind in ('measured', 'commands')
                  for name, bounds in (('trained', faces[own.signal].training),
                                       ('limit', faces[own.signal].limits))
                  for end in bounds or () if math.isfinite(end))
    found: list[dict[str, Any]] = []
    labels: dict[str, dict[str, None]] = {}  # of the signals, by name of the limit
    labelled: dict[str, Any] = {'yAxis': -math.inf}
    for end, label, name in ends:
        found.append({'yAxis': end, 'name': ''})
        # labels of lines that are near would cover each other: they have one
        if end - labelled['yAxis'] >= _NEAR * height:
            labelled, labels = found[-1], {}
        labels.setdefault(name, {})[label] = None
        labelled['name'] = '; '.join(f'{", ".join(of)} {what}' for what, of in labels.items())
    return found + [{
        'xAxis': 1e3 * mark.time, 'name': mark.label, 'text': mark.text.replace('; ', '\n'),
        'symbol': 'circle', 'label': {'position': 'insideEndTop'},
        'lineStyle': {'type': 'solid', 'color': _ABNORMAL if mark.alarm else _QUIET}}
        for mark in marks]


def ink(number: int) -> str:
    """Return the colour of a pen of a chart: black, then distinct hues."""
    # by the golden ratio from blue on
    share = (0.618034 * number - 0.035) % 1.0
    red, green, blue = colorsys.hls_to_rgb(share, 0.28 + 0.14 * (number % 2), 0.4)
    return f'#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}' if (
        number) else '#1d1d1b'


def legend_rows(names: Sequence[str], width: int) -> int:
    """Return the number of rows that names of pens take in a width in pixels."""
    rows, room = 1, width
    for needed in (7 * len(name) + 49 for name in names):
        if needed > room:
            rows, room = rows + 1, width
        room -= needed
    return rows


def _rows(charts: _Charts, width: int) -> list[int]:
    """Return the pixels for further rows of names of each chart."""
    return [_ROW * (legend_rows([pen(own.kind, own.label) for own in pens], width) - 1)
            for _, pens in charts]


def _places(charts: _Charts, height: int, width: int) -> dict[str, Any]:
    """Return the options for the places of charts and their names."""
    rows = _rows(charts, width)
    tops = [height * at + sum(rows[:at]) for at in range(len(rows))]
    return {'legend': [{'top': top + 4} for top in tops],
            'grid': [{'top': top + _HEAD + more} for top, more in zip(tops, rows, strict=True)]}


def _options(charts: _Charts, height: int, zoom: bool) -> dict[str, Any]:
    """Return the options of charts without data, one above the other."""
    several = range(len(charts))
    pens = [(at, number, own) for at, (_, own_pens) in enumerate(charts)
            for number, own in enumerate(own_pens)]
    order = [list(dict.fromkeys(own.signal for own in own_pens)) for _, own_pens in charts]
    marked = {'symbol': 'none', 'symbolSize': 8, 'animation': False,
              'lineStyle': {'type': 'dashed', 'color': '#8a8a86'},
              # at the other end than the newest events
              'label': {'formatter': '{b}', 'position': 'insideStartTop', 'fontSize': 10,
                        'color': '#4d4d4a', 'backgroundColor': 'rgba(217,217,214,.75)'},
              'emphasis': {'label': {':formatter': 'p => p.data.text || p.name', 'rotate': 0,
                                     'fontSize': 12, 'color': '#1d1d1b', 'padding': 4,
                                     'backgroundColor': '#f4f4f2'}}}
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
        'media': [{'query': {'minWidth': width}, 'option': _places(charts, height, room)}
                  for width, room in _WIDTHS.items()],
        'legend': [{'type': 'plain',
                    'data': [own.title for own in own_pens if own.kind != 'planned'],
                    # the unit is at the axis
                    ':formatter': "name => name.split(' [')[0]",
                    'textStyle': {'color': '#1d1d1b', 'fontSize': 13},
                    # a symbol would hide the gap of the dashes
                    'itemStyle': {'opacity': 0}, 'itemHeight': 12, 'itemWidth': 34}
                   for _, own_pens in charts],
        # all charts have the same width, also below a long name
        'grid': [{'left': 56, 'right': 16, 'height': height - _HEAD - _FOOT,
                  'outerBoundsContain': 'axisLabel'} for _ in charts],
        'xAxis': [{'type': 'time', 'gridIndex': at, 'nameLocation': 'middle', 'nameGap': 22,
                   'nameTextStyle': {'color': '#4d4d4a'},
                   'axisPointer': {'label': {':formatter': f'p => ({_CLOCK})(p.value)'}},
                   'axisLabel': {':formatter': _CLOCK, 'hideOverlap': True, 'color': '#1d1d1b'}}
            for at in several],
        'yAxis': [{'type': 'value', 'scale': True, 'gridIndex': at, 'boundaryGap': ['4%', '4%'],
                   'name': f'{", ".join(dict.fromkeys(own.label for own in own_pens))} [{unit}]',
                   'axisLabel': {'color': '#1d1d1b', 'hideOverlap': True},
                   'nameTextStyle': {'color': '#1d1d1b', 'align': 'left'},
                   'splitLine': {'lineStyle': {'color': '#c4c4c0'}}}
                  for at, (unit, own_pens) in enumerate(charts)],
        'dataZoom': [] if not zoom else [
            {'type': 'inside', 'xAxisIndex': list(several), 'filterMode': 'none'},
            {'type': 'slider', 'xAxisIndex': list(several), 'bottom': 6, 'height': 24,
             'filterMode': 'none', 'showDataShadow': False, 'labelFormatter': '', **grey}],
        'series': [{'type': 'line', 'name': own.title, 'symbol': 'none',
                    'xAxisIndex': at, 'yAxisIndex': at, 'data': [],
                    'step': 'end' if own.steps else False,
                    'color': ink(number), 'markLine': marked,
                    'lineStyle': line(own.kind, order[at].index(own.signal))}
                   for at, number, own in pens]}


def line(kind: str, place: int) -> dict[str, Any]:
    """Return the style of a line of a kind; `place` is that of its signal in the chart."""
    width, dashes = _LINES.get(kind, (2.2, _DASHES[place % len(_DASHES)]))
    return {'width': width, 'type': dashes or 'solid'}
