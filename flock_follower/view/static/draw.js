// Copyright 2026 The flock_follower developers. Licensed under the Apache License, Version 2.0.
// The two drawings of the page: the scene from above, and the distance over time.

const RADII = [3, 4, 5, 6, 8, 10, 15, 20, 30, 50, 100]; // m shown to each side
const HISTORY = 60; // s
const TAU = 2 * Math.PI;

/** Return the value of a CSS variable of the theme. */
export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Paints as the server names them; states of the planner are paints, too. */
function paint(name) {
  return css(`--c-${name}`) || css(`--${name.toLowerCase()}`) || css('--muted');
}

/** Draw the scene; return the radius shown, m. */
export function drawTop(canvas, flight) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return 0;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const c = canvas.getContext('2d');
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, width, height);
  const boxes = flight.scene.filter((shape) => shape.k === 'box');
  if (!boxes.length) {
    c.fillStyle = css('--muted');
    c.font = '600 15px system-ui, sans-serif';
    c.textAlign = 'center';
    c.fillText('no odometry, no neighbor', width / 2, height / 2);
    return 0;
  }
  const middle = (values) => (Math.min(...values) + Math.max(...values)) / 2;
  const cx = middle(boxes.map(({p}) => p[0][0])), cy = middle(boxes.map(({p}) => p[0][1]));
  const reach = Math.max(2.5, ...boxes.map(({p}) => Math.hypot(p[0][0] - cx, p[0][1] - cy) + 1.2));
  const radius = RADII.find((r) => r >= reach) || RADII[RADII.length - 1];
  const scale = Math.min(width, height) / (2 * radius);
  const at = ([x, y]) => [width / 2 + (x - cx) * scale, height / 2 - (y - cy) * scale];

  const step = radius > 12 ? 5 : 1;
  c.lineWidth = 1;
  c.strokeStyle = css('--grid');
  c.beginPath();
  for (let x = Math.ceil((cx - width / 2 / scale) / step) * step; x < cx + width / 2 / scale; x += step) {
    const [px] = at([x, 0]);
    c.moveTo(px, 0); c.lineTo(px, height);
  }
  for (let y = Math.ceil((cy - height / 2 / scale) / step) * step; y < cy + height / 2 / scale; y += step) {
    const [, py] = at([0, y]);
    c.moveTo(0, py); c.lineTo(width, py);
  }
  c.stroke();

  for (const [name, track] of Object.entries(flight.tracks)) {
    c.strokeStyle = name === '' ? css('--text') : paint('seen');
    c.lineWidth = 1.5;
    c.globalAlpha = 0.55;
    line(c, track.map(([, x, y]) => at([x, y])));
    c.globalAlpha = 1;
  }
  for (const shape of flight.scene) {
    const color = paint(shape.c), points = shape.p.map(at);
    if (shape.k === 'ellipsoid') {
      c.fillStyle = color;
      c.globalAlpha = 0.25;
      c.beginPath();
      points.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
      c.fill();
      c.globalAlpha = 1;
    } else if (shape.k === 'line') {
      c.strokeStyle = color;
      c.lineWidth = shape.w > 0.03 ? 4 : 1.5;
      c.setLineDash(shape.c === 'edge' ? [4, 4] : []);
      line(c, points);
      c.setLineDash([]);
    }
  }
  for (const shape of flight.scene) {
    const color = paint(shape.c), points = shape.p.map(at);
    if (shape.k === 'arrow') arrow(c, points[0], points[1], color);
    else if (shape.k === 'box') dart(c, points[0], shape.a, Math.max(11, 0.22 * scale), color);
  }
  c.font = '600 13px system-ui, sans-serif';
  c.textAlign = 'center';
  for (const shape of flight.scene) {
    if (shape.k !== 'text' || shape.n === 'state') continue;
    const [x, y] = at(shape.p[0]);
    label(c, shape.t, Math.min(Math.max(x, 40), width - 40), y - Math.max(18, 0.3 * scale), paint(shape.c));
  }
  axes(c, height);
  return radius;
}

function line(c, points) {
  c.beginPath();
  points.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
  c.stroke();
}

function arrow(c, [ax, ay], [bx, by], color) {
  const angle = Math.atan2(by - ay, bx - ax);
  c.strokeStyle = c.fillStyle = color;
  c.lineWidth = 3;
  line(c, [[ax, ay], [bx, by]]);
  c.beginPath();
  c.moveTo(bx + 5 * Math.cos(angle), by + 5 * Math.sin(angle));
  c.lineTo(bx + 7 * Math.cos(angle + 2.4), by + 7 * Math.sin(angle + 2.4));
  c.lineTo(bx + 7 * Math.cos(angle - 2.4), by + 7 * Math.sin(angle - 2.4));
  c.fill();
}

/** Draw a vehicle whose nose points along its yaw, rad, anticlockwise from x. */
function dart(c, [x, y], yaw, size, color) {
  const corner = (turn, length) => [x + length * Math.cos(yaw + turn), y - length * Math.sin(yaw + turn)];
  c.fillStyle = color;
  c.strokeStyle = css('--card');
  c.lineWidth = 2;
  c.beginPath();
  c.moveTo(...corner(0, 1.25 * size));
  c.lineTo(...corner(2.5, size));
  c.lineTo(...corner(Math.PI, 0.45 * size));
  c.lineTo(...corner(-2.5, size));
  c.closePath();
  c.fill();
  c.stroke();
}

function label(c, text, x, y, color) {
  c.lineWidth = 4;
  c.lineJoin = 'round';
  c.strokeStyle = css('--card');
  c.strokeText(text, x, y);
  c.fillStyle = color;
  c.fillText(text, x, y);
}

/** The axes of the odometry's frame. */
function axes(c, height) {
  const x = 16, y = height - 16;
  arrow(c, [x, y], [x + 26, y], css('--muted'));
  arrow(c, [x, y], [x, y - 26], css('--muted'));
  c.font = '600 12px system-ui, sans-serif';
  c.textAlign = 'left';
  label(c, 'x', x + 36, y + 4, css('--muted'));
  label(c, 'y', x - 4, y - 36, css('--muted'));
}

/** The chart of the distance; `set(points, band, now)` draws points [t, m], s. */
export class Chart {
  constructor(element) {
    this.element = element;
    const axis = {stroke: () => css('--muted'), grid: {stroke: () => css('--grid'), width: 1},
      ticks: {stroke: () => css('--grid'), width: 1}, font: '12px system-ui, sans-serif'};
    const edge = (color) => ({stroke: () => css(color), width: 1.5, dash: [6, 4], points: {show: false}});
    this.plot = new window.uPlot({
      width: element.clientWidth || 300, height: element.clientHeight || 200,
      legend: {show: false}, cursor: {show: false}, padding: [10, 12, 0, 0],
      scales: {x: {time: false, range: [-HISTORY, 0]}, y: {range: (_, low, high) => [0, Math.max(high, 1) * 1.08]}},
      axes: [{...axis, values: (_, ticks) => ticks.map((t) => (t === 0 ? 'now' : `${t} s`))},
        {...axis, size: 56, values: (_, ticks) => ticks.map((m) => `${m} m`)}],
      series: [{}, edge('--c-inner'), edge('--c-outer'),
        {stroke: () => css('--text'), width: 2.5, points: {show: false}, spanGaps: false}],
      bands: [{series: [2, 1], fill: () => css('--inside')}],
    }, [[], [], [], []], element);
    new ResizeObserver(() => this.plot.setSize(
      {width: element.clientWidth, height: element.clientHeight})).observe(element);
  }

  set(points, band, now) {
    const x = [-HISTORY], near = [band ? band[0] : null], far = [band ? band[1] : null], m = [null];
    let before = null;
    for (const [t, distance] of points) {
      if (before !== null && t - before > 0.6) { // a gap stays a gap
        x.push((t + before) / 2 - now); near.push(near[0]); far.push(far[0]); m.push(null);
      }
      before = t;
      x.push(t - now); near.push(near[0]); far.push(far[0]); m.push(distance);
    }
    x.push(0); near.push(near[0]); far.push(far[0]); m.push(null);
    this.plot.setData([x, near, far, m]);
  }
}
