# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of the reactor at its saddle from its temperature alone, with the true model."""

from studies import saddle


def test_without_the_concentration_the_same_law_costs_hardly_more(monkeypatch):
    monkeypatch.setattr(saddle, 'LAWS', {'sdre': ('sdre',)})
    monkeypatch.setattr(saddle, 'COURSE', {0.0: 350.0, 30.0: 345.0})
    monkeypatch.setattr(saddle, 'FOULED', 330.0)
    monkeypatch.setattr(saddle, 'END', 530.0)
    (row,) = saddle.course_rows([saddle.truth()], periods=(1.0,))
    law, period, over_true, worst, over_full, _, offset, concentration, *lost = row
    assert (law, period, over_true, worst) == ('sdre', '1', '1.0000', '1.0000')
    assert 0.9 < float(over_full) < 1.1
    assert float(offset) < 0.05
    assert float(concentration) < 2e-3
    assert lost == ['0 of 1', '1.0000', '0 of 1', '0 of 1']


def test_what_physics_allows_is_told_from_what_it_does_not(monkeypatch):
    monkeypatch.setattr(saddle, 'LAWS', {'mpc': ('sdre',)})
    monkeypatch.setattr(saddle, 'ARRIVAL', 500.0)
    monkeypatch.setattr(saddle, 'DISTURBANCES', {
        name: saddle.DISTURBANCES[name] for name in ('T_f +5 K', 'UA -20 %')})
    held, beyond = ([float(figure) for figure in row[1:]]
                    for row in saddle.disturbance_rows([saddle.truth()]))
    assert max(held[0], held[2]) < 1.5
    assert max(held[1], held[3]) < 0.05
    # nobody holds that with the coolant at 1 K/s
    assert min(beyond) > 10.0


def test_starts_that_are_lost_are_lost_by_full_information_too(monkeypatch):
    monkeypatch.setattr(saddle, 'STARTS', 4)
    monkeypatch.setattr(saddle, 'ARRIVAL', 120.0)
    informed, own = (saddle.lost(saddle.controller(
        saddle.truth(), ('sdre',), saddle.WIDE, informed=full), 0) for full in (True, False))
    # two of these four are beyond any coolant
    assert informed == own == {2, 3}
