# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""No text from outside becomes props, a class, a style, markup or code of a page."""

import asyncio
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

from nicegui import Client, ui
from nicegui.page import page as ui_page
import pytest
import yaml

from koopman_ros.panel.alarm_page import alarm_page, alarm_strip
from koopman_ros.panel.audit_page import audit_page
from koopman_ros.panel.layout import attribute, Frame, label, LOOPS, PageLayout, Visitor
from koopman_ros.panel.loop_page import loop_page
from koopman_ros.panel.model_page import model_page
from koopman_ros.panel.overview import overview
from koopman_ros.panel.requests import Answer, Role
from koopman_ros.panel.trend_page import trend_page
from koopman_ros.panel.tuning_page import exported, tuning_page
from support.hostile import CODE, HostileSource, TEXTS

PAGES = {'/': overview, '/trends': trend_page, '/alarms': alarm_page, '/model': model_page,
         '/tuning': tuning_page, '/audit': audit_page}
#: values of props that are shown as text, or are names of things of the page itself
TEXT_PROPS = {'alt', 'aria-label', 'data-parameter', 'data-signal', 'data-title', 'label',
              'model-value', 'value', 'options'}


@pytest.fixture
def client() -> Iterator[Client]:
    """Return a client without a browser."""
    own = Client(ui_page('/test'))
    with own:
        yield own
    own.delete()


def keys_and_texts(value: Any) -> Iterator[tuple[str, Any]]:
    """List the keys of options, however deep, with their values."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield key, item
            yield from keys_and_texts(item)
    elif isinstance(value, list):
        for item in value:
            yield from keys_and_texts(item)


@pytest.mark.parametrize('role', Role)
@pytest.mark.parametrize('path', [*PAGES, LOOPS])
def test_hostile_texts_of_all_sources_stay_texts(
        client: Client, path: str, role: Role) -> None:
    visitor = Visitor(TEXTS[0], lambda: role)
    if path == LOOPS:
        sources = {name: HostileSource() for name in ('/line_1', '/line_2')}
        shown_page: Frame = Frame(sources, visitor, '/', LOOPS, [*sources.values()])
        loop_page(shown_page)
    else:
        shown_page = layout = PageLayout({'': HostileSource()}, '', visitor, path)
        alarm_strip(layout)
        PAGES[path](layout)
    shown_page.update()
    shown = 0
    for element in client.elements.values():
        assert CODE not in element.tag
        assert not any(CODE in name for name in element.classes)
        assert CODE not in str(dict(element.style))
        for key, value in element.props.items():
            assert not key.startswith((':', 'on')), (element, key)
            assert key not in ('innerHTML', 'srcdoc')
            assert CODE not in key
            assert CODE not in str(value) or key in TEXT_PROPS, (element, key)
            shown += CODE in str(value)
        for key, value in keys_and_texts(element.props.get('options')):
            assert CODE not in key
            if 'formatter' in key.lower():
                assert CODE not in value
        for slot in element.slots.values():
            assert not slot.template
        shown += CODE in str(getattr(element, 'text', ''))
    assert shown > 3, 'the texts are there'
    assert CODE not in client.head_html + client.body_html


def test_chart_tooltips_escape_markup(client: Client) -> None:
    trend_page(PageLayout({'': HostileSource()}, '', Visitor('anna', lambda: Role.ENGINEER),
                          '/trends'))
    (chart,) = (own for own in client.elements.values() if isinstance(own, ui.echart))
    assert chart.options['tooltip']['renderMode'] == 'richText'


def test_the_tasks_of_a_closed_page_end(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    source, waiting = HostileSource(), Future[Answer]()
    monkeypatch.setattr(source, 'request', lambda _: waiting)
    layout = PageLayout({'': source}, '', Visitor('anna', lambda: Role.ENGINEER), '/')

    async def closed() -> None:
        task = asyncio.ensure_future(layout.act('train'))
        await asyncio.sleep(0.0)
        client.remove_all_elements()
        waiting.set_result(Answer(True, 'late'))
        await task

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(closed())


@pytest.mark.parametrize(('text', 'shown'), [
    ('valve: 0 percent is below 5 percent', 'valve: 0 % is below 5 %'),
    ('limited to 32 degC', 'limited to 32 °C'), ('the percentage of degrees', None)])
def test_units_are_written_as_people_write_them(
        client: Client, text: str, shown: str | None) -> None:
    assert label('div', text).text == (shown or text)


@pytest.mark.parametrize('name', [':aria-label', 'onclick', 'style', 'class', 'innerHTML', 'a b'])
def test_other_attributes_are_not_set(client: Client, name: str) -> None:
    with pytest.raises(ValueError, match='cannot be set'):
        attribute(ui.element('div'), name, 'text')


@pytest.mark.parametrize('address', ['javascript:1', '//elsewhere', 'https://elsewhere', 'data:,'])
def test_addresses_are_those_of_the_panel(client: Client, address: str) -> None:
    with pytest.raises(ValueError, match='cannot be set'):
        attribute(ui.element('a'), 'href', address)


def test_exported_parameters_are_yaml_of_the_same_names_whatever_these_are() -> None:
    found = HostileSource().snapshot.parameters['controller']
    found = {f'{name}\n  :': view for name, view in found.items() if isinstance(view.value, float)}
    read = yaml.safe_load(exported('controller', found))
    assert read == {'/**/controller': {'ros__parameters': dict.fromkeys(found, 1.0)}}
