// Copyright 2026 The flock_follower developers. Licensed under the Apache License, Version 2.0.
// The live page: takes messages of the view node by a WebSocket, and shows them as text.

import {Chart, drawTop} from './draw.js';

const SILENCE = 1.5; // s without a message after which everything here is old
const RETRY = 1000; // ms between two attempts to connect
const HOLD = 1000; // ms for which Land is held
const DRAW = 200; // ms between two drawings of the chart
const HISTORY = 60; // s
const TRACK_PERIOD = 0.2; // s between two points of a track
const TITLES = {brake: 'Brake', land: 'Land'};

const $ = (id) => document.getElementById(id);
const flight = {scene: [], tracks: {}, distances: [], band: null, now: 0};
let socket = null, received = -Infinity, drawn = 0, chart = null, picture = null;

/** Show a text; whatever it holds, it stays text. */
function show(id, text, stale = false) {
  const element = $(id);
  if (element.textContent !== text) element.textContent = text;
  element.classList.toggle('stale', stale);
}

function seconds(age) {
  return age === null ? 'never' : age < 10 ? `${age.toFixed(1)} s` : `${Math.round(age)} s`;
}

function take(message) {
  if (message.about) about(message.about);
  else if (message.history) takeHistory(message.history);
  else if (message.answer) answer(message.answer);
  else if (message.state) takeState(message.state);
}

function about({name, computer, control}) {
  show('name', `flock_follower · ${name}`);
  document.title = `${name} · flock_follower`;
  const port = location.port || '80';
  show('tunnel', `ssh -L ${port}:127.0.0.1:${port} USER@${computer}`);
  show('here', `http://127.0.0.1:${port}`);
  $('controls').hidden = control === 'off';
  for (const id of ['brake', 'land']) $(id).disabled = control !== '';
  if (control === 'token') answer({success: false, text: 'To use the buttons, open the address with the token that the node printed.'});
}

function takeHistory({t, distances, tracks}) {
  // What the node has forgotten by its restart, this page still has.
  const keep = (own, theirs) => [
    ...own.filter(([time]) => time < (theirs.length ? theirs[0][0] : t) && time > t - HISTORY && time <= t), ...theirs];
  flight.distances = keep(flight.distances, distances);
  for (const name of new Set([...Object.keys(flight.tracks), ...Object.keys(tracks)])) {
    flight.tracks[name] = keep(flight.tracks[name] || [], tracks[name] || []);
  }
}

function takeState(state) {
  const now = flight.now = state.t;
  flight.scene = state.scene;
  flight.band = state.band || flight.band;
  follow('', state.own, now);
  for (const [name, place] of Object.entries(state.neighbors)) follow(name, place, now);
  for (const [name, track] of Object.entries(flight.tracks)) {
    while (track.length && track[0][0] < now - HISTORY) track.shift();
    if (!track.length) delete flight.tracks[name];
  }
  const distance = state.distance;
  if (!distance.stale) flight.distances.push([now - distance.age, distance.m]);
  while (flight.distances.length && flight.distances[0][0] < now - HISTORY) flight.distances.shift();

  $('state-card').dataset.state = state.state;
  show('state', state.state || '–');
  $('state').classList.toggle('long', state.state.length > 8);
  show('reason', state.reason || (state.engaged === 'True' ? 'engaged' : ''));
  showDistance(distance, state.band);
  showBridge(state);
  showWarnings(state.warnings);
  showSources(state.ages, state.rates);
  const age = state.ages.find(([source]) => source === 'image')[1];
  show('image-age', age === null ? '' : `${seconds(age)} old`);
  const fresh = age !== null && age <= 1.0;
  $('image').classList.toggle('old', !fresh);
  if (!fresh || picture === null) { $('no-image').hidden = false; show('no-image', age === null ? 'no image received' : fresh ? '' : `no image for ${seconds(age)}`); }
  else $('no-image').hidden = true;
}

function follow(name, place, now) {
  if (!place) return;
  const track = flight.tracks[name] = flight.tracks[name] || [];
  if (!track.length || now - track[track.length - 1][0] >= TRACK_PERIOD) track.push([now, ...place]);
}

function showDistance({name, m, stale}, band) {
  show('leader', name);
  show('distance', m === null ? '–' : m.toFixed(2), m !== null && stale);
  show('band', (band ? `band ${band[0].toFixed(2)} to ${band[1].toFixed(2)} m` : 'band unknown') +
    (m !== null && stale ? '; distance is old' : ''));
  const most = Math.max(band ? 1.25 * band[1] : 4, m || 0);
  $('inside').style.left = band ? `${100 * band[0] / most}%` : '0';
  $('inside').style.width = band ? `${100 * (band[1] - band[0]) / most}%` : '0';
  $('needle').hidden = m === null || stale;
  $('needle').style.left = `${100 * (m || 0) / most}%`;
}

function showBridge({ages, bridge, limits, limited_by: limited, setpoint, battery}) {
  $('bridge-card').dataset.bridge = bridge.state;
  const never = ages.find(([source]) => source === 'bridge state')[1] === null;
  show('bridge', never ? 'NO BRIDGE' : bridge.lost ? 'BRIDGE LOST' : bridge.state);
  show('bridge-reason', bridge.reason);
  show('vehicle', [bridge.autopilot && `${bridge.autopilot} ${bridge.firmware}`.trim(), bridge.mode,
    bridge.armed && (bridge.armed === 'True' ? 'armed' : 'disarmed'),
    bridge.flying && (bridge.flying === 'True' ? 'in the air' : 'on the ground'),
    bridge.height_m && bridge.height_m !== 'unknown' && `height ${bridge.height_m} m`].filter(Boolean).join(' · '));
  show('limits', limits || 'not bounded');
  $('limits').classList.toggle('guarded', Boolean(limits));
  show('gate', [limited && `bridge: ${limited}`, setpoint && `setpoint: ${setpoint}`].filter(Boolean).join(' · '));
  const {share, voltage} = battery;
  show('battery', share === null && voltage === null ? 'battery unknown' : ['battery',
    share === null ? '' : `${Math.round(100 * share)} %`, voltage === null ? '' : `${voltage.toFixed(1)} V`]
    .filter(Boolean).join(' '), battery.stale && voltage !== null);
  $('battery').classList.toggle('low', share !== null && share < 0.25);
}

function row(cells, kind) {
  const line = document.createElement('tr');
  line.className = kind;
  for (const text of cells) line.append(Object.assign(document.createElement('td'), {textContent: text}));
  return line;
}

function showWarnings(warnings) {
  const serious = warnings.length;
  show('count', serious ? String(serious) : '');
  const list = warnings.map(({level, node, text}) => {
    const item = document.createElement('li');
    item.className = level;
    item.append(Object.assign(document.createElement('strong'), {textContent: node}), document.createTextNode(text));
    return item;
  });
  if (!list.length) list.push(Object.assign(document.createElement('li'), {className: 'none', textContent: 'none'}));
  $('warnings').replaceChildren(...list);
}

function showSources(ages, rates) {
  $('sources').replaceChildren(...ages.map(([source, age, stale, sporadic]) =>
    row([source, age === null ? 'none yet' : `${seconds(age)} ago`],
      !stale ? '' : sporadic && age === null ? 'quiet' : 'silent')));
  $('rates').replaceChildren(...rates.map(([title, value, stale]) =>
    row([title, title.endsWith('ms') ? value : `${value} Hz`], stale ? 'quiet' : '')));
}

function showImage(blob) {
  const address = URL.createObjectURL(blob), image = $('image');
  const before = picture;
  picture = address;
  image.onload = image.onerror = () => before && URL.revokeObjectURL(before);
  image.src = address;
  image.hidden = false;
}

function answer({button, success, text}) {
  show('answer', button ? `${TITLES[button]}: ${text}` : text);
  $('answer').classList.toggle('bad', !success);
}

function press(button) {
  if (!socket || socket.readyState !== WebSocket.OPEN) {
    answer({button, success: false, text: 'not sent: no connection'});
    return;
  }
  answer({button, success: true, text: 'requested'});
  socket.send(JSON.stringify({button}));
}

function prepareButtons() {
  $('brake').addEventListener('click', () => press('brake'));
  const land = $('land');
  let timer = null;
  const begin = () => {
    if (timer !== null) return;
    land.classList.add('held');
    timer = setTimeout(() => { end(); press('land'); }, HOLD);
  };
  const end = () => {
    clearTimeout(timer);
    timer = null;
    land.classList.remove('held');
  };
  land.addEventListener('pointerdown', (event) => { if (event.button === 0) begin(); });
  for (const kind of ['pointerup', 'pointerleave', 'pointercancel', 'blur', 'keyup']) land.addEventListener(kind, end);
  land.addEventListener('keydown', (event) => { if (!event.repeat && [' ', 'Enter'].includes(event.key)) begin(); });
  land.addEventListener('contextmenu', (event) => event.preventDefault());
}

function connect() {
  if (socket || document.hidden) return;
  const mine = socket = new WebSocket(`ws://${location.host}/ws`);
  mine.binaryType = 'blob';
  mine.onmessage = ({data}) => {
    received = performance.now();
    if (typeof data === 'string') take(JSON.parse(data));
    else showImage(data);
  };
  mine.onclose = () => {
    if (socket === mine) socket = null;
    setTimeout(connect, RETRY);
    // The node may have started again with another token.
    fetch('/', {method: 'GET'}).then((reply) => { if (reply.status === 403) refused(reply); }, () => {});
  };
}

async function refused(reply) {
  show('banner', await reply.text());
}

function watch() {
  const silent = (performance.now() - received) / 1000, dead = !(silent <= SILENCE);
  document.body.classList.toggle('dead', dead);
  show('link', dead ? 'no data' : 'live');
  if (dead && !$('banner').textContent.startsWith('token')) {
    show('banner', received === -Infinity ? 'No data yet: connecting to the view node.' :
      `No data for ${seconds(silent)}: the view node has ended, or the link is lost. Everything below is old.`);
  }
  if (!dead && !chart) chart = new Chart($('chart'));
  if (!dead && performance.now() - drawn >= DRAW) {
    drawn = performance.now();
    chart.set(flight.distances, flight.band, flight.now);
  }
  if (!dead) {
    const radius = drawTop($('top'), flight);
    show('scale', radius ? `grid ${radius > 12 ? 5 : 1} m` : '');
  }
}

const THEMES = ['auto', 'light', 'dark'];
const prefersDark = matchMedia('(prefers-color-scheme: dark)');

function theme(name) {
  const dark = name === 'dark' || (name === 'auto' && prefersDark.matches);
  document.documentElement.toggleAttribute('data-dark', dark);
  show('theme', name);
  if (chart) chart.plot.redraw();
}

function prepareTheme() {
  let name = 'auto';
  try { name = localStorage.getItem('theme') || 'auto'; } catch { /* no storage: automatic */ }
  theme(THEMES.includes(name) ? name : 'auto');
  $('theme').addEventListener('click', () => {
    name = THEMES[(THEMES.indexOf($('theme').textContent) + 1) % THEMES.length];
    try { localStorage.setItem('theme', name); } catch { /* kept for this page alone */ }
    theme(name);
  });
  prefersDark.addEventListener('change', () => theme($('theme').textContent));
}

prepareTheme();
prepareButtons();
// A page in the background costs the vehicle nothing.
document.addEventListener('visibilitychange', () => {
  if (document.hidden && socket) socket.close();
  else connect();
});
connect();
setInterval(watch, 100);
