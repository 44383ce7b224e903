// The picture by WebGL2: one draw call for all solid geoms, one for the glass; the bodies' poses are in a texture.

const SHADER_HEAD = `#version 300 es
precision highp float; precision highp int; precision highp sampler2DShadow;
`;
const SHADER_BODY = `${SHADER_HEAD}
layout(location = 0) in vec3 point; layout(location = 1) in vec4 normal;
layout(location = 2) in vec4 colour; layout(location = 3) in uvec4 look;
uniform highp sampler2D poses; uniform int hand;
vec4 pose(int part) { return texelFetch(poses, ivec2(2 * int(look.x + 256u * look.y) + part, hand), 0); }
vec3 turn(vec3 v) { vec4 q = pose(1); vec3 side = 2. * cross(q.yzw, v); return v + q.x * side + cross(q.yzw, side); }
`;
const DEPTH_VERTEX = `${SHADER_BODY}
uniform mat4 view;
void main() { gl_Position = view * vec4(pose(0).xyz + turn(point), 1); }`;
const DEPTH_PIXEL = `${SHADER_HEAD}
void main() {}`;
const SOLID_VERTEX = `${SHADER_BODY}
uniform mat4 view;
out vec3 place, facing; out vec4 paint; out vec2 gloss;
void main() {
  place = pose(0).xyz + turn(point); facing = turn(normal.xyz);
  paint = colour; gloss = vec2(look.zw) / 255.;
  gl_Position = view * vec4(place, 1);
}`;
const FLOOR_VERTEX = `${SHADER_HEAD}
uniform mat4 view;
uniform vec4 ground; // middle of the floor, half its width
uniform vec3 tone;
out vec3 place, facing; out vec4 paint; out vec2 gloss;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2. - 1.;
  place = ground.xyz + vec3(corner * ground.w, 0); facing = vec3(0, 0, 1);
  paint = vec4(tone, 1); gloss = vec2(0);
  gl_Position = view * vec4(place, 1);
}`;
// A key light that casts shadows, a weak second one, and a sky. How much of the sky a point sees is the share of points around
// it that nothing hides from above: it darkens what lies under something, and where things touch.
const LIT_PIXEL = `${SHADER_HEAD}
uniform vec3 eye, key; uniform vec4 ground; uniform mat4 keyView, skyView;
uniform sampler2DShadow keyMap, skyMap; uniform float samples, reach; uniform bool open, isFloor;
in vec3 place, facing; in vec4 paint; in vec2 gloss; out vec4 pixel;

float unhidden(sampler2DShadow map, mat4 view, vec3 n, float lift, float wide, float bias) {
  vec3 at = (view * vec4(place + lift * n, 1)).xyz * .5 + .5, tilt = mat3(view) * n;
  vec2 slope = clamp(-tilt.xy / (2.89 * tilt.z), -4., 4.); // a slanted surface must not hide itself; 2.89: see parallel()
  if (any(greaterThan(abs(at.xy - .5), vec2(.5)))) return 1.;
  float turned = 6.2832 * fract(52.98292 * fract(dot(gl_FragCoord.xy, vec2(.0671106, .00583715)))), sum = 0.;
  for (float i = 0.; i < samples; i++) {
    float angle = turned + 2.4 * i;
    vec2 away = wide * sqrt((i + .5) / samples) * vec2(cos(angle), sin(angle));
    sum += texture(map, vec3(at.xy + away, min(at.z + dot(away, slope) - bias, .9995)));
  }
  return sum / samples;
}

void main() {
  vec3 base = pow(paint.rgb, vec3(2.2)), back = normalize(eye - place), n = normalize(facing);
  // At a sharp edge of a mesh, its normals are means of faces.
  vec3 facet = normalize(cross(dFdx(place), dFdy(place)));
  facet *= sign(dot(facet, back));
  if (dot(n, facet) < .8) n = facet;
  float alpha = paint.a;
  if (isFloor) {
    vec2 cell = place.xy / (.35 * reach), edge = max(fwidth(cell), vec2(1e-4));
    vec2 wave = smoothstep(-edge, edge, abs(fract(.5 * cell) - .5) - .25);
    base *= mix(.94 + .1 * abs(wave.x - wave.y), .99, min(1., max(edge.x, edge.y)));
    alpha = smoothstep(1., .25, length(place.xy - ground.xy) / ground.w);
  } else if (dot(n, back) < 0.) {
    n = -n;
  }
  float towards = dot(n, key);
  float sun = towards > 0. ? towards * unhidden(keyMap, keyView, n, .004 * reach, .0022, open ? .0006 : .003) : 0.;
  float free = open ? .3 + .7 * unhidden(skyMap, skyView, n, .01 * reach, .035, .002) : .8;
  vec3 sky = mix(vec3(.17, .165, .16), vec3(.5, .52, .56), .5 + .5 * n.z) * free;
  vec3 light = sky + 1.25 * sun * vec3(1, .965, .91) + .18 * free * max(0., dot(n, normalize(vec3(.55, .45, .5))));
  float sharp = exp2(2. + 7. * gloss.y);
  float shiny = pow(max(0., dot(n, normalize(key + back))), sharp) * (sharp + 8.) / 60.;
  float rim = pow(1. - max(0., dot(n, back)), 4.);
  vec3 colour = base * light + gloss.x * (.35 * min(shiny, 3.) * sun + .3 * rim * sky);
  pixel = vec4(pow(1.08 * colour / (colour * .16 + 1.), vec3(1. / 2.2)) * alpha, alpha);
}`;

/** a b, both column by column */
function multiply(a, b) {
  const entry = (row, column) => a[row] * b[column] + a[row + 4] * b[column + 1] + a[row + 8] * b[column + 2] + a[row + 12] * b[column + 3];
  return a.map((_, i) => entry(i & 3, i & 12));
}

/** From the world to an eye that looks along `forward`; the picture's upper side is towards `up`. */
function lookAlong(eye, forward, up) {
  const f = unit(forward), r = unit(cross(f, up)), u = cross(r, f);
  return [r[0], u[0], -f[0], 0, r[1], u[1], -f[1], 0, r[2], u[2], -f[2], 0, -dot(r, eye), -dot(u, eye), dot(f, eye), 1];
}

function perspective(tangent, aspect, near, far) {
  const depth = 1 / (near - far);
  return [1 / (tangent * aspect), 0, 0, 0, 0, 1 / tangent, 0, 0, 0, 0, (far + near) * depth, -1, 0, 0, 2 * far * near * depth, 0];
}

/** A light far away, in whose picture is a ball around the middle; it is 1.7 times as deep as wide. */
function parallel(middle, radius, direction, up) {
  const narrow = [1 / radius, 0, 0, 0, 0, 1 / radius, 0, 0, 0, 0, -1 / (1.7 * radius), 0, 0, 0, 0, 1];
  return multiply(narrow, lookAlong(middle, direction, up));
}

/** Returns where the tile of each hand is: [left, top, width, height]. */
function tilesOf(hands, width, height) {
  const rowsOf = (columns) => Math.ceil(hands / columns);
  const room = (columns) => Math.min(width / columns, 1.3 * height / rowsOf(columns));
  let columns = 1;
  for (let more = 2; more <= hands; more++) if (room(more) > room(columns)) columns = more;
  const w = Math.floor(width / columns), h = Math.floor(height / rowsOf(columns));
  return Array.from({ length: hands }, (_, hand) => [hand % columns * w, Math.floor(hand / columns) * h, w, h]);
}

const KEY_LIGHT = unit([-.25, -.5, 1]);

/** Whether WebGL is calculated by the processor, as on virtual machines and remote desktops. */
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  let name = gl.getParameter(gl.RENDERER);
  const detail = /webkit/i.test(name) && gl.getExtension("WEBGL_debug_renderer_info"); // Chrome tells it only there
  if (detail) name = gl.getParameter(detail.UNMASKED_RENDERER_WEBGL);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

function makeProgram(gl, vertex, pixel) {
  const program = gl.createProgram(), complaints = [];
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, pixel]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    complaints.push(gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error([...complaints, gl.getProgramInfoLog(program)].filter(Boolean).join(" "));
  }
  const places = {};
  for (let i = 0; i < (gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0); i++) {
    const { name } = gl.getActiveUniform(program, i);
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

function upload(gl, { points, normals, colours, looks, triangles }) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  const fill = (target, data) => { gl.bindBuffer(target, gl.createBuffer()); gl.bufferData(target, data, gl.STATIC_DRAW); };
  const inputs = [[points, 3, gl.FLOAT], [normals, 4, gl.BYTE], [colours, 4, gl.UNSIGNED_BYTE], [looks, 4, gl.UNSIGNED_BYTE]];
  inputs.forEach(([data, size, type], i) => {
    fill(gl.ARRAY_BUFFER, data);
    gl.enableVertexAttribArray(i);
    if (data === looks) gl.vertexAttribIPointer(i, size, type, 0, 0);
    else gl.vertexAttribPointer(i, size, type, true, 0, 0);
  });
  fill(gl.ELEMENT_ARRAY_BUFFER, triangles);
  gl.bindVertexArray(null);
  return { array, count: triangles.length };
}

function makeTexture(gl, format, width, height, filter) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  return texture;
}

function makeDepthMap(gl, size) {
  const texture = makeTexture(gl, gl.DEPTH_COMPONENT24, size, size, gl.LINEAR), target = gl.createFramebuffer();
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
  return { texture, target, size };
}

class CardPicture {
  /** Returns a picture, or null without WebGL2. A simple one has primitives, fewer samples and fewer pixels. */
  static on(canvas, scene, meshes, hands, simple) {
    const gl = canvas.getContext("webgl2", { antialias: !simple, powerPreference: "low-power" });
    return gl && new CardPicture(gl, scene, meshes, hands, simple);
  }

  constructor(gl, scene, meshes, hands, simple) {
    Object.assign(this, { gl, scene, hands, samples: simple ? 2 : 14, open: !simple, pixels: simple ? .6 : 1 });
    const parts = formsOf(scene, meshes, simple, simple ? 12 : 32), glass = ({ geom }) => geom.rgba[3] < 1;
    this.solid = upload(gl, buffersOf(parts.filter((part) => !glass(part))));
    this.glass = upload(gl, buffersOf(parts.filter(glass)));
    this.nothing = gl.createVertexArray();
    this.poses = makeTexture(gl, gl.RGBA32F, 2 * scene.bodies.length, hands, gl.NEAREST);
    this.depth = makeProgram(gl, DEPTH_VERTEX, DEPTH_PIXEL);
    this.lit = makeProgram(gl, SOLID_VERTEX, LIT_PIXEL);
    this.floor = makeProgram(gl, FLOOR_VERTEX, LIT_PIXEL);
    this.reach = .52 * scene.camera.distance;
    const { center } = scene.camera;
    this.key = { ...makeDepthMap(gl, simple ? 512 : 2048), view: parallel(center, this.reach, KEY_LIGHT.map((x) => -x), [0, 0, 1]) };
    this.sky = { ...makeDepthMap(gl, 512), view: parallel(center, this.reach, [0, 0, -1], [0, 1, 0]) };
  }

  /** Draws less carefully from now on. */
  easier() {
    if (this.samples > 4) this.samples = 4;
    else if (this.pixels > .5) this.pixels = .5;
    else [this.samples, this.open] = [1, false];
  }

  draw(poses, sight, tone) {
    const { gl } = this;
    this.bind(0, this.poses);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 2 * this.scene.bodies.length, this.hands, gl.RGBA, gl.FLOAT, poses);
    this.bind(1, this.key.texture);
    this.bind(2, this.sky.texture);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { width, height } = gl.canvas;
    tilesOf(this.hands, width, height).forEach(([x, y, w, h], hand) => {
      for (const map of this.open ? [this.key, this.sky] : [this.key]) this.drawDepth(map, hand);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(x, height - y - h, w, h);
      this.drawTile(hand, sight, w / h, tone);
    });
  }

  bind(unit, texture) {
    this.gl.activeTexture(this.gl.TEXTURE0 + unit);
    this.gl.bindTexture(this.gl.TEXTURE_2D, texture);
  }

  use({ program, places }, values) {
    const { gl } = this;
    gl.useProgram(program);
    for (const [name, value] of Object.entries(values)) {
      const place = places[name] ?? null;
      if (value.length === 16) gl.uniformMatrix4fv(place, false, value);
      else if (value.length) gl[`uniform${value.length}fv`](place, value);
      else gl.uniform1f(place, value);
    }
    Object.entries({ poses: 0, keyMap: 1, skyMap: 2 }).forEach(([name, unit]) => gl.uniform1i(places[name] ?? null, unit));
  }

  drawParts({ array, count }, { places }, hand) {
    const { gl } = this;
    gl.bindVertexArray(array);
    gl.uniform1i(places.hand, hand);
    gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
  }

  drawDepth({ target, size, view }, hand) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, size, size);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.use(this.depth, { view });
    this.drawParts(this.solid, this.depth, hand);
  }

  drawTile(hand, { eye, forward, distance, tangent }, aspect, tone) {
    const { gl, scene, reach, samples } = this, { center } = scene.camera;
    // A narrow tile shows as much from side to side as a square one.
    const lens = perspective(tangent * Math.max(1, .9 / aspect), aspect, .02 * distance, 70 * distance);
    const view = multiply(lens, lookAlong(eye, forward, [0, 0, 1]));
    const ground = [center[0], center[1], scene.floor ?? 0, 9 * reach], key = KEY_LIGHT;
    const values = { view, eye, key, keyView: this.key.view, skyView: this.sky.view, samples, reach, ground, tone };
    const use = (program, isFloor) => this.use(program, { ...values, open: Number(this.open), isFloor });
    gl.disable(gl.BLEND);
    use(this.lit, 0);
    this.drawParts(this.solid, this.lit, hand);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (scene.floor !== null) {
      use(this.floor, 1);
      gl.bindVertexArray(this.nothing);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
    use(this.lit, 0);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    for (const hidden of [gl.FRONT, gl.BACK]) {
      gl.cullFace(hidden);
      this.drawParts(this.glass, this.lit, hand);
    }
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
  }
}
