// SPDX-FileCopyrightText: 2026 The koopman_ros Authors
// SPDX-License-Identifier: Apache-2.0

// Shows since when the panel is silent, by the clock of the browser alone. Where the session has
// ended in the meantime, the panel accepts no new connection: the page then becomes that to log in.
addEventListener('DOMContentLoaded', () => {
  let last = Date.now(), seen = null, waiting = false;
  const bar = document.createElement('div');
  bar.id = 'lost'; bar.className = 'banner hidden'; bar.setAttribute('role', 'alert');
  document.body.prepend(bar);
  setInterval(() => {
    const beat = document.getElementById('beat');
    if (beat && beat.dataset.beat !== seen) { seen = beat.dataset.beat; last = Date.now(); }
    const lost = Date.now() - last > 4000;
    bar.classList.toggle('hidden', !lost);
    if (lost) bar.textContent = '\u26a0 Connection lost: no message from the panel since '
      + new Date(last).toLocaleTimeString() + '. The values are old.';
    if (lost && !waiting) {
      waiting = true;
      fetch('/session').then(response => { if (response.status === 401) location.reload(); })
        .catch(() => {}).finally(() => setTimeout(() => { waiting = false; }, 4000));
    }
  }, 500);
});
