// The scenes, in metres in the camera's frame, as large as the lens sees them: one unit is half the picture's height at
// the subject.
const SCENES = ["night", "chart", "white"];
const MOST_BALLS = 40, DOT = 0.03; // DOT: radius of the chart's dots in units

const PORTRAIT = [ // centre and radius in units, depth behind the subject; height over width; colour
  [[-0.3, 0.2, 0], 0.24, 1.28, [0.72, 0.46, 0.34]], // head
  [[-0.3, 0.31, 0.08], 0.26, 1.12, [0.07, 0.04, 0.03]], // hair
  [[-0.3, 0.17, -0.235], 0.034, 1.3, [0.72, 0.45, 0.34]], // nose
  [[-0.39, 0.25, -0.195], 0.032, 1, [0.03, 0.03, 0.04]],
  [[-0.21, 0.25, -0.195], 0.032, 1, [0.03, 0.03, 0.04]],
  [[-0.3, -0.12, 0.04], 0.1, 1.6, [0.66, 0.41, 0.3]], // neck
  [[-0.3, -0.92, 0.1], 0.52, 1.25, [0.12, 0.2, 0.42]], // coat, the last of the person
  [[0.98, -0.72, -0.22], 0.17, 1, [0.65, 0.1, 0.07]], // in front
  [[0.62, -0.6, 1.1], 0.4, 1.3, [0.08, 0.3, 0.14]], // behind
];
const PERSON = 7;
const LAMPS = [ // place in the picture (units), distance over the subject's, radius in the picture, colour
  [-1.55, 0.62, 4.2, 0.022, 0], [-1.32, 0.18, 3.1, 0.018, 1], [-1.2, 0.8, 5, 0.024, 2], [-1.02, 0.44, 3.8, 0.02, 0],
  [-0.86, 0.86, 4.6, 0.018, 1], [-0.78, 0.12, 2.6, 0.016, 3], [-0.05, 0.84, 5.2, 0.022, 0], [0.12, 0.5, 3.4, 0.02, 1],
  [0.3, 0.78, 4.4, 0.022, 4], [0.36, 0.2, 3, 0.018, 0], [0.52, 0.52, 5.6, 0.024, 2], [0.66, 0.86, 3.6, 0.018, 0],
  [0.78, 0.3, 4.8, 0.022, 1], [0.95, 0.64, 2.8, 0.018, 3], [1.1, 0.1, 4, 0.02, 0], [1.18, 0.84, 5.4, 0.024, 1],
  [1.34, 0.46, 3.2, 0.018, 4], [1.5, 0.74, 4.6, 0.022, 0], [1.6, 0.22, 3.8, 0.02, 2], [0.06, 0.16, 6, 0.02, 0],
];
const LIGHTS = [[12, 6.4, 2.4], [10, 8.5, 5.6], [3.4, 5.8, 11], [12, 2.2, 1.3], [2.8, 9.5, 4]];

const LAMP_FAR = 30, LAMP_RADIUS = 0.25; // times the subject's distance; degrees

/**
 * Uniforms of a scene: `unit` in m at the distance `far` in m; `lamp` one more, {towards, irradiance at the lens in sr,
 * over the radiance of white}.
 */
function sceneUniforms(name, far, unit, lamp = null) {
  const ball = new Float32Array(4 * MOST_BALLS), coat = new Float32Array(4 * MOST_BALLS);
  let n = 0;
  const put = (place, radius, colour, height) => {
    ball.set([...place, radius], 4 * n);
    coat.set([...colour, height], 4 * n++);
  };
  for (const [[x, y, z], radius, height, colour] of PORTRAIT)
    put([x * unit, y * unit, -far - z * unit], radius * unit, colour, height);
  const solids = n;
  for (const [x, y, times, radius, light] of LAMPS)
    put([x, y, 0].map((v, k) => (k < 2 ? v * unit * times : -far * times)), radius * unit * times, LIGHTS[light], -1);
  if (lamp) {
    const radius = Math.sin((LAMP_RADIUS * Math.PI) / 180), bright = lamp.irradiance / (Math.PI * radius ** 2);
    put(lamp.towards.map((v) => v * LAMP_FAR * far), LAMP_FAR * far * radius, [bright, bright, bright], -1);
  }
  const around = [...boxAround(ball, coat, 0, PERSON), ...boxAround(ball, coat, solids, n)];
  return {
    scene: SCENES.indexOf(name), ball, coat, around, person: PERSON, solids, balls: n, chart_z: -far, chart_half: unit, floor_y: -1.25 * unit,
    key: [1.3 * unit, 1.5 * unit, -far + 1.6 * unit, 0.3 * unit], key_power: 5.5 * unit * unit,
  };
}

/** Low and high corners of the box around some balls. */
function boxAround(ball, coat, from, to) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let n = from; n < to; n++)
    for (let k = 0; k < 3; k++) {
      const reach = ball[4 * n + 3] * (k === 1 ? Math.abs(coat[4 * n + 3]) : 1);
      low[k] = Math.min(low[k], ball[4 * n + k] - reach);
      high[k] = Math.max(high[k], ball[4 * n + k] + reach);
    }
  return [...low, ...high];
}
