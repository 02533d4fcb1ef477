// SPDX-FileCopyrightText: 2026 The koopman_ros Authors
// SPDX-License-Identifier: Apache-2.0

// What a page shows of its connection to the panel, which the panel itself cannot know of.
const watched = {};  // what is known of the connection once the page is there
{
  let socket;
  Object.defineProperty(window, 'socket', {
    get: () => socket, set: own => { socket = own; watched.wrap?.(own); } });
}
addEventListener('DOMContentLoaded', () => {
  const stored = sessionStorage, now = () => performance.now();
  const bar = (id, more = '') => {
    const one = document.createElement('div');
    one.id = id; one.className = `banner hidden ${more}`; one.setAttribute('role', 'alert');
    document.body.prepend(one);
    return one;
  };
  const unsent = bar('unsent'), lost = bar('lost');
  let last = now(), seen = null, waiting = false;

  // Presses that the panel has not confirmed. Each carries the panel's time that its page showed, by
  // which the panel refuses one that arrives late. They outlast a reload of the page.
  const open = new Map();
  let pressed = null, presses = 0;
  const keep = () => { stored.presses = JSON.stringify([...open.values()].map(one => one.text)); };
  const tell = (texts, what) => {
    unsent.textContent = `✖ ${what}: ${texts.join('; ')}. The connection was interrupted: check the `
      + 'value shown, and enter the command again if it is still needed. ';
    const button = document.createElement('button');
    button.textContent = 'Close'; button.onclick = () => unsent.classList.add('hidden');
    unsent.append(button);
    unsent.classList.remove('hidden');
  };
  const close = (id, what) => {
    const one = open.get(id);
    if (!one) return;
    open.delete(id); keep();
    one.answer?.classList.remove('pending');
    if (what) tell([one.text], what);
  };
  try {
    const before = JSON.parse(stored.presses || '[]');
    if (before.length) tell(before, 'Not confirmed');
  } catch { /* another page's */ }
  keep();
  const press = control => {
    const entry = control.closest('.ask, .parameter')?.querySelector('input');
    const name = (entry ?? control).getAttribute('aria-label') || control.innerText
      || control.getAttribute('title') || 'a control';
    const answer = control.closest('.card, .parameter, .alarm')?.querySelector('.answer');
    const at = new Date().toTimeString().slice(0, 8);
    pressed = { id: ++presses, seen, answer,
                text: `${name.trim()}${entry ? ` = ${entry.value}` : ''} (${at})` };
    setTimeout(() => { pressed = null; }, 0);
  };
  addEventListener('click', event => {
    const control = event.target.closest('button, .q-toggle, [role=option]');
    if (control && !unsent.contains(control)) press(control);
  }, true);
  addEventListener('keydown', event => {
    if (event.key === 'Enter' && event.target.matches('input:not([type=range])')) {
      press(event.target);
    }
  }, true);
  const wrap = socket => {
    const emit = socket.emit.bind(socket);
    socket.emit = (name, ...args) => {
      if (name === 'event' && pressed) {
        const { id, seen } = pressed;
        if (!open.has(id)) { open.set(id, pressed); keep(); }
        pressed.answer?.classList.add('pending');
        args[0].press = { id, seen };
      }
      return emit(name, ...args);
    };
    socket.on('pressed', ({ id, late }) => close(id, late ? 'Not sent' : ''));
  };
  watched.wrap = wrap;
  if (window.socket) wrap(window.socket);

  // An entry shows the present value until another one is typed, and again after an answer to that.
  // What differs is marked as typed and not sent. Its slider follows the text, and the text its
  // slider; the arrow keys step both.
  const number = text => Number(text.trim().replace(',', '.'));
  const write = (field, text) => {
    field.value = text;
    field.dispatchEvent(new Event('input', { bubbles: true }));
  };
  const type = (field, value, step) => {
    write(field, value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))));
  };
  const parts = ask => [ask.querySelector('input:not([type=range])'),
                        ask.querySelector('input[type=range]')];
  const shown = new WeakMap();  // the attributes of each entry, when last seen
  const follow = () => {
    for (const one of document.querySelectorAll('.ask[data-present]')) {
      const [field] = parts(one), { present, answered } = one.dataset, before = shown.get(one);
      if (!field || (before?.present === present && before?.answered === answered)) continue;
      shown.set(one, { present, answered });
      if (field.value === (before?.present ?? '') || (answered && field.value === answered)) {
        write(field, present);
      }
    }
  };
  const mark = () => {
    for (const one of document.querySelectorAll('.ask[data-present]')) {
      const [field, slider] = parts(one), typed = field?.value ?? '';
      one.classList.toggle('typed', typed !== '' && typed !== one.dataset.present);
      if (slider && !Number.isNaN(number(typed))) slider.value = number(typed);
    }
  };
  addEventListener('focusin', mark);
  addEventListener('input', event => {
    if (event.target.type === 'range') {
      type(parts(event.target.closest('.ask'))[0], event.target.valueAsNumber, event.target.step);
    }
    mark();
  });
  addEventListener('keydown', event => {
    const ask = event.target.closest?.('.ask[data-present]');
    if (!ask || !event.target.matches('input')) return;
    const [field, slider] = parts(ask), value = number(field.value);
    if (event.key === 'Escape') write(field, ask.dataset.present);
    if (event.target === slider && ['Enter', 'Escape'].includes(event.key)) {
      field.dispatchEvent(new KeyboardEvent('keydown', { key: event.key, bubbles: true }));
      if (event.key === 'Escape') slider.blur();
    } else if (event.target === field && ['ArrowUp', 'ArrowDown'].includes(event.key)
               && !Number.isNaN(value)) {
      event.preventDefault();
      type(field, value + (event.key === 'ArrowUp' ? 1 : -1) * slider.step, slider.step);
    }
  });

  // A row that moves, or appears, does nothing for half a second: a click was for the one before.
  const tops = new WeakMap(), timers = new WeakMap();
  new MutationObserver(() => {
    for (const row of document.querySelectorAll('.alarm')) {
      const top = row.offsetTop;
      if (tops.get(row) === top) continue;
      tops.set(row, top);
      row.inert = true;
      clearTimeout(timers.get(row));
      timers.set(row, setTimeout(() => { row.inert = false; }, 500));
    }
  }).observe(document.body, { subtree: true, childList: true, attributes: true,
                              attributeFilter: ['class'], characterData: true });

  // The sound is switched on in each browser; it repeats while an alarm is not acknowledged.
  let audio = null;
  const sounds = () => stored.sound === 'on';
  const beep = tone => {
    audio ??= new AudioContext();
    const tune = audio.createOscillator(), volume = audio.createGain();
    tune.frequency.value = tone; volume.gain.value = 0.2;
    tune.connect(volume).connect(audio.destination);
    tune.start(); tune.stop(audio.currentTime + 0.25);
  };
  addEventListener('click', event => {
    if (!event.target.closest('#sound')) return;
    stored.sound = sounds() ? 'off' : 'on';
    if (sounds()) beep(440);
  });
  setInterval(() => {
    const head = document.querySelector('[data-title]');
    if (head && !lost.classList.contains('hidden') && sounds()) beep(330);
    else if (head?.dataset.sound && sounds()) beep(Number(head.dataset.sound));
  }, 2000);

  const tick = () => {
    const beat = document.getElementById('beat'), head = document.querySelector('[data-title]');
    if (head && document.title !== head.dataset.title) document.title = head.dataset.title;
    const sound = document.getElementById('sound');
    sound?.setAttribute('aria-pressed', String(sounds()));
    follow();
    mark();
    if (beat && beat.dataset.beat !== seen) {
      seen = beat.dataset.beat; last = now();
      for (const one of open.values()) one.heard ??= last;
    }
    // the panel is heard again, and has not confirmed the press
    for (const [id, one] of open) if (now() - one.heard > 3000) close(id, 'Not confirmed');
    const gone = now() - last > 4000;
    if (gone && lost.classList.contains('hidden')) {
      lost.textContent = '\u26a0 Connection lost: no message from the panel since '
        + `${(beat?.textContent ?? '').slice(-8)}. The values are old.`;
    }
    lost.classList.toggle('hidden', !gone);
    // what is pressed meanwhile, or before the page is connected, would be carried out later
    for (const one of document.body.children) {
      if (one !== lost && one !== unsent) one.inert = gone || !window.did_handshake;
    }
    // where the session has ended meanwhile, the panel accepts no new connection
    if (gone && !waiting) {
      waiting = true;
      fetch('/session').then(response => { if (response.status === 401) location.reload(); })
        .catch(() => {}).finally(() => setTimeout(() => { waiting = false; }, 4000));
    }
  };
  tick();
  setInterval(tick, 200);
});
