// SPDX-FileCopyrightText: 2026 The koopman_ros Authors
// SPDX-License-Identifier: Apache-2.0

// Shows since when the panel is silent, by its own clock and zone, and disables the page meanwhile:
// what is pressed would be carried out when the panel is back. Where the session has ended in the
// meantime, the panel accepts no new connection: the page then becomes that to log in.
addEventListener('DOMContentLoaded', () => {
  let last = performance.now(), seen = null, waiting = false;
  const bar = document.createElement('div');
  bar.id = 'lost'; bar.className = 'banner hidden'; bar.setAttribute('role', 'alert');
  document.body.prepend(bar);
  setInterval(() => {
    const beat = document.getElementById('beat');
    if (beat && beat.dataset.beat !== seen) { seen = beat.dataset.beat; last = performance.now(); }
    const lost = performance.now() - last > 4000;
    if (lost && bar.classList.contains('hidden')) {
      bar.textContent = '\u26a0 Connection lost: no message from the panel since '
        + `${(beat?.textContent ?? '').slice(-8)}. The values are old.`;
    }
    bar.classList.toggle('hidden', !lost);
    for (const one of document.body.children) if (one !== bar) one.inert = lost;
    if (lost && !waiting) {
      waiting = true;
      fetch('/session').then(response => { if (response.status === 401) location.reload(); })
        .catch(() => {}).finally(() => setTimeout(() => { waiting = false; }, 4000));
    }
  }, 500);
});
// A browser drops a comma from a number: 45,5 would become 455.
addEventListener('beforeinput', event => {
  if (event.target.type === 'number' && event.data?.includes(',')) {
    event.preventDefault();
    document.execCommand('insertText', false, event.data.replaceAll(',', '.'));
  }
});
