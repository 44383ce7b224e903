// Shapes as faces: {points, normals: [[x, y, z], ...], faces: [[corner, ...], ...]}; faces are convex, counter-clockwise from outside.

/** Turns a profile around the z axis; it goes upwards: [[radius, height, the normal's radial part, the normal's height], ...]. */
function revolve(profile, sides) {
  const form = { points: [], normals: [], faces: [] }, around = sides + 1;
  for (const [radius, z, out, up] of profile) {
    for (let side = 0; side <= sides; side++) {
      const angle = 2 * Math.PI * side / sides, x = Math.cos(angle), y = Math.sin(angle);
      form.points.push([radius * x, radius * y, z]);
      form.normals.push([out * x, out * y, up]);
    }
  }
  for (let i = 0; i < (profile.length - 1) * around; i++) {
    if (i % around < sides) form.faces.push([i, i + 1, i + around + 1, i + around]);
  }
  return form;
}

/** A profile of a sphere's part, from one latitude to another, in quarters of a turn. */
function arc(from, to, steps, radius, height) {
  return Array.from({ length: steps + 1 }, (_, i) => {
    const latitude = (from + (to - from) * i / steps) * Math.PI / 2, out = Math.cos(latitude), up = Math.sin(latitude);
    return [radius * out, height + radius * up, out, up];
  });
}

function stretch(form, [a, b, c]) {
  const { points, faces } = form;
  const normals = points.map(([x, y, z]) => unit([x / a, y / b, z / c]));
  return { faces, normals, points: points.map(([x, y, z]) => [a * x, b * y, c * z]) };
}

function boxOf(half) {
  const form = { points: [], normals: [], faces: [] };
  for (let side = 0; side < 6; side++) {
    const axis = side >> 1, sign = side & 1 ? 1 : -1, first = form.points.length;
    for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
      const corner = [], normal = [0, 0, 0];
      corner[axis] = sign * half[axis];
      corner[(axis + 1) % 3] = sign * u * half[(axis + 1) % 3];
      corner[(axis + 2) % 3] = v * half[(axis + 2) % 3];
      normal[axis] = sign;
      form.points.push(corner);
      form.normals.push(normal);
    }
    form.faces.push([first, first + 1, first + 2, first + 3]);
  }
  return form;
}

/** A rectangle in its own x-y plane; where a half length is 0, MuJoCo's plane has no end, and this one is 2 m wide. */
function planeOf([a, b]) {
  const x = a || 1, y = b || 1, up = [0, 0, 1];
  return { points: [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]], normals: [up, up, up, up], faces: [[0, 1, 2, 3]] };
}

/** Returns the form of a geom; `sides` is the number of sides of what is round. */
function formOf({ type, size }, sides) {
  const [a, b] = size, steps = Math.max(2, Math.round(sides / 4)), ball = () => revolve(arc(-1, 1, 2 * steps, 1, 0), sides);
  const makers = {
    sphere: () => stretch(ball(), [a, a, a]),
    ellipsoid: () => stretch(ball(), size),
    capsule: () => revolve([...arc(-1, 0, steps, a, -b), ...arc(0, 1, steps, a, b)], sides),
    cylinder: () => revolve([[0, -b, 0, -1], [a, -b, 0, -1], [a, -b, 1, 0], [a, b, 1, 0], [a, b, 0, 1], [0, b, 0, 1]], sides),
    box: () => boxOf(size),
    plane: () => planeOf(size),
  };
  return makers[type]?.() ?? { points: [], normals: [], faces: [] };
}

/** Reads the meshes: points in 16 bits of their box, normals in 8 bits, triangles as differences. */
function readMeshes(list, bytes) {
  let begin = 0;
  const take = (count) => (begin += count) - count;
  return list.map(({ points: count, triangles, low, step }) => {
    const places = readTable(bytes, take(6 * count), count, 3), normals = take(3 * count);
    const corners = readTable(bytes, take(6 * triangles), 3 * triangles, 1);
    const axes = [0, 1, 2], signed = (byte) => byte << 24 >> 24;
    return {
      points: Array.from({ length: count }, (_, i) => axes.map((k) => low[k] + step[k] * (places[3 * i + k] + 32768))),
      normals: Array.from({ length: count }, (_, i) => unit(axes.map((k) => signed(bytes[normals + k * count + i])))),
      faces: Array.from({ length: triangles }, (_, i) => axes.map((k) => corners[3 * i + k] & 65535)),
    };
  });
}

/** Makes a mesh coarser: all points in a cell of a grid become one. Few faces are left as they are. */
function coarsen(form, cells) {
  if (form.faces.length < 300) return form;
  const axes = [0, 1, 2], range = (pick) => axes.map((k) => form.points.reduce((best, point) => pick(best, point[k]), form.points[0][k]));
  const low = range(Math.min), cell = Math.max(...plus(range(Math.max), low, -1)) / cells, seen = new Map();
  const first = form.points.map((point, i) => {
    const name = axes.map((k) => Math.round((point[k] - low[k]) / cell)).join();
    if (!seen.has(name)) seen.set(name, i);
    return seen.get(name);
  });
  const faces = form.faces.map((face) => face.map((i) => first[i])).filter((face) => new Set(face).size === face.length);
  return { ...form, faces };
}

/** The geoms of a picture with their forms; the simple pictures have primitives in place of the fine meshes. */
function formsOf(scene, meshes, simple, sides) {
  const wanted = scene.geoms.filter((geom) => !geom[simple ? "fine" : "plain"] && (geom.type !== "mesh" || meshes[geom.mesh]));
  return wanted.map((geom) => {
    const form = geom.type === "mesh" ? meshes[geom.mesh] : formOf(geom, sides);
    return { geom, form: simple && geom.type === "mesh" ? coarsen(form, sides) : form };
  });
}

/** Puts forms into arrays for the graphics card; `looks` has per point: body (low byte, high byte), specular, shininess. */
function buffersOf(parts) {
  const count = parts.reduce((sum, { form }) => sum + form.points.length, 0), triangles = [];
  const points = new Float32Array(3 * count), normals = new Int8Array(4 * count), colours = new Uint8Array(4 * count);
  const looks = new Uint8Array(4 * count), byte = (share) => Math.round(255 * share);
  let at = 0;
  for (const { geom, form } of parts) {
    for (const face of form.faces) {
      for (let i = 2; i < face.length; i++) triangles.push(at + face[0], at + face[i - 1], at + face[i]);
    }
    form.points.forEach((point, i) => {
      points.set(plus(geom.pos, rotate(geom.quat, point)), 3 * at);
      normals.set(rotate(geom.quat, form.normals[i]).map((x) => Math.round(127 * x)), 4 * at);
      colours.set(geom.rgba.map(byte), 4 * at);
      looks.set([geom.body & 255, geom.body >> 8, byte(geom.specular), byte(geom.shininess)], 4 * at);
      at++;
    });
  }
  return { points, normals, colours, looks, triangles: new Uint32Array(triangles) };
}
