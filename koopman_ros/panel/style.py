# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Style sheet of the pages, with colour for abnormal conditions alone, and their watchdog."""

CSS = """
:root { --ground: #d9d9d6; --card: #e9e9e6; --line: #a9a9a5; --text: #1d1d1b; --quiet: #4d4d4a;
  --bar: #c4c4c0; --train: #b2b2ad; --ink: #3b3b38; --focus: #0b4f8a;
  --high: #a40000; --medium: #8a4b00; --low: #5b4a00; }
body { background: var(--ground); color: var(--text); font-size: 16px;
  font-family: system-ui, Roboto, sans-serif; }
.nicegui-content { padding: 0; gap: 0; align-items: stretch; }
.quiet { color: var(--quiet); }
a { color: var(--text); }
:focus-visible { outline: 3px solid var(--focus) !important; outline-offset: 1px; }
.head { display: flex; flex-wrap: wrap; gap: 4px 24px; align-items: baseline;
  padding: 8px 16px; background: #cbcbc7; border-bottom: 1px solid var(--line); }
.head h1 { font-size: 1.25rem; line-height: 1.3; margin: 0; font-weight: 600; }
.head .right { margin-left: auto; }
.tabs { display: flex; flex-wrap: wrap; gap: 0; padding: 0 8px; background: #cbcbc7;
  border-bottom: 1px solid var(--line); }
.tabs a { padding: 10px 14px; text-decoration: none; }
.tabs a.here { background: var(--ground); font-weight: 600; border: 1px solid var(--line);
  border-bottom: none; }
.page { padding: 12px 16px; display: flex; flex-direction: column; gap: 12px; }
.cards { display: flex; flex-wrap: wrap; gap: 12px; }
.cards > * { flex: 1 1 max(min(320px, 100%), 33.3% - 12px); }
.cards:has(> :nth-child(4):last-child) > * { flex-basis: max(min(320px, 100%), 50% - 12px); }
.loose { align-items: start; }
.card { background: var(--card); border: 1px solid var(--line); padding: 12px 14px;
  display: flex; flex-direction: column; gap: 8px; min-width: 0; overflow-wrap: break-word; }
.card[inert] > :not(h2) { opacity: .45; }
.page h2 { font-size: 1.05rem; line-height: 1.3; margin: 0; font-weight: 600; }
.row1 { display: flex; flex-wrap: wrap; gap: 4px 16px; align-items: baseline; }
.between { justify-content: space-between; }
.big { font-size: 3.4rem; line-height: 1.05; font-weight: 600;
  font-variant-numeric: tabular-nums; }
.mode { font-size: 2.4rem; line-height: 1.2; font-weight: 600; }
.unit { font-size: 1.1rem; }
.value { font-size: 1.5rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.abnormal { align-self: flex-start; color: #fff; background: var(--medium); padding: 2px 8px;
  font-weight: 600; }
.high { color: #fff; background: var(--high); padding: 2px 8px; font-weight: 700; }
.medium { color: #fff; background: var(--medium); padding: 2px 8px; font-weight: 700; }
.low { color: #fff; background: var(--low); padding: 2px 8px; font-weight: 700; }
.hidden { display: none !important; }
.bar { position: relative; height: 34px; background: var(--bar); border: 1px solid var(--line); }
.bar > div { position: absolute; top: 0; bottom: 0; }
.bar .train { background: var(--train); }
.bar .fill { left: 0; top: 9px; bottom: 9px; background: var(--ink); }
.bar .tick { width: 3px; margin-left: -1px; background: var(--text); }
.bar .tick::before { content: ''; position: absolute; left: -6px; top: -1px; width: 0;
  border: 7.5px solid transparent; border-top: 9px solid var(--text); border-bottom: 0; }
.bar .limit { width: 0; border-left: 2px dashed var(--text); }
.scale { display: flex; justify-content: space-between; font-size: .85rem; color: var(--quiet); }
.ask { display: flex; gap: 8px; align-items: center; }
.ask .q-field { flex: 1 1 120px; min-width: 0; }
.answer { min-height: 1.4em; }
.answer.refused { color: var(--high); font-weight: 600; }
.strip { display: flex; flex-direction: column; gap: 6px; }
.alarm .q-btn { padding: 0 10px; }
.alarm { display: flex; flex-wrap: wrap; gap: 4px 12px; align-items: center;
  background: var(--card); border: 1px solid var(--line); padding: 4px 10px; }
.alarm .what { flex: 1 1 240px; min-width: 0; overflow-wrap: anywhere; }
.banner { background: var(--high); color: #fff; font-weight: 700; padding: 10px 16px; }
#lost { position: sticky; top: 0; z-index: 9000; }
.changes { display: grid; gap: 4px 16px;
  grid-template-columns: minmax(0, 3fr) minmax(0, 2fr) minmax(0, 2fr); }
.pairs { display: grid; gap: 2px 32px; }
.columns { grid-template-columns: repeat(auto-fill, minmax(min(320px, 100%), 1fr)); }
.pair { display: grid; grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); gap: 12px; }
.lines { white-space: pre-line; }
.middle { align-items: center; }
.parameter { display: grid; width: 100%; gap: 2px 12px; align-items: center; padding: 6px 0;
  border-top: 1px solid var(--line); grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); }
.q-btn { min-height: 40px; text-transform: none; }
.q-field__control { background: #f4f4f2; }
.q-dialog .card { background: var(--card); max-width: 560px; }
.nicegui-echart { width: 100%; }
.trends { height: var(--from-0); }
@media (min-width: 640px) { .trends { height: var(--from-600); } }
@media (min-width: 940px) { .trends { height: var(--from-900); } }
.card .picture { display: block; max-width: 100%; height: auto; background: #fff; }
.report { white-space: pre-wrap; overflow-wrap: anywhere; font-family: monospace;
  font-size: .85rem; }
.journal { font-variant-numeric: tabular-nums; }
@media (max-width: 600px) {
  .page { padding: 8px; }
  .tabs { padding: 0; }
  .tabs a { padding: 10px 7px; font-size: .95rem; }
  .head { padding: 6px 8px; }
  .parameter { grid-template-columns: minmax(0, 1fr); }
  .big { font-size: 3rem; }
  .changes { grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); }
  .changes > :nth-child(3n + 1) { grid-column: 1 / -1; color: var(--quiet); }
}
"""

# Shows since when the panel is silent, by the clock of the browser alone.
WATCH = """
<script>
addEventListener('DOMContentLoaded', () => {
  let last = Date.now(), seen = null;
  const bar = document.createElement('div');
  bar.id = 'lost'; bar.className = 'banner hidden'; bar.setAttribute('role', 'alert');
  document.body.prepend(bar);
  setInterval(() => {
    const beat = document.getElementById('beat');
    if (beat && beat.dataset.beat !== seen) { seen = beat.dataset.beat; last = Date.now(); }
    const lost = Date.now() - last > 4000;
    bar.classList.toggle('hidden', !lost);
    if (lost) bar.textContent = '\\u26a0 Connection lost: no message from the panel since '
      + new Date(last).toLocaleTimeString() + '. The values are old.';
  }, 500);
});
</script>
"""
