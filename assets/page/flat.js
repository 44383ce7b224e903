// The picture without WebGL: flat faces on a plain canvas, the farthest first.

class FlatPicture {
  constructor(canvas, scene, meshes, hands) {
    Object.assign(this, { context: canvas.getContext("2d"), scene, hands, pixels: 1, shadows: true });
    this.parts = formsOf(scene, meshes, true, 8).map(({ geom, form }) => {
      const used = [...new Set(form.faces.flat())], names = new Map(used.map((corner, i) => [corner, i]));
      const points = used.map((corner) => plus(geom.pos, rotate(geom.quat, form.points[corner])));
      return { geom, points, faces: form.faces.map((face) => face.map((corner) => names.get(corner))) };
    });
  }

  easier() {
    if (this.pixels < 1) this.shadows = false;
    this.pixels = .6;
  }

  draw(poses, sight) {
    const { context, scene, hands } = this, { width, height } = context.canvas, size = 8 * scene.bodies.length;
    context.clearRect(0, 0, width, height);
    tilesOf(hands, width, height).forEach((tile, hand) => {
      context.save();
      context.beginPath();
      context.rect(...tile);
      context.clip();
      this.drawTile(poses.subarray(hand * size, (hand + 1) * size), sight, tile);
      context.restore();
    });
  }

  drawTile(poses, sight, tile) {
    const { context, scene } = this, project = projectionOf(sight, tile);
    const faces = [], shadow = new Path2D();
    for (const { geom, points, faces: corners } of this.parts) {
      const pose = [...poses.subarray(8 * geom.body, 8 * geom.body + 8)], quat = pose.slice(4), glass = geom.rgba[3] < 1;
      const world = points.map((point) => plus(pose, rotate(quat, point))), seen = world.map(project);
      const onFloor = (p) => project(plus(p, KEY_LIGHT, (scene.floor - p[2]) / KEY_LIGHT[2]));
      const cast = scene.floor === null || glass || !this.shadows ? null : world.map(onFloor);
      for (const face of corners) {
        if (cast && face.every((i) => cast[i][2] > .02)) trace(shadow, face.map((i) => cast[i]));
        const screen = face.map((i) => seen[i]);
        if (areaOf(screen) >= 0 || screen.some(([, , depth]) => depth < .02)) continue; // turned away, or behind the eye
        const depth = screen.reduce((sum, [, , z]) => sum + z, 0) / screen.length;
        faces.push({ screen, glass, depth, colour: shade(geom.rgba, world, face) });
      }
    }
    context.fillStyle = "rgba(0, 0, 0, .2)";
    context.fill(shadow);
    for (const { screen, glass, colour } of faces.sort((a, b) => b.depth - a.depth)) {
      const path = trace(new Path2D(), screen);
      context.fillStyle = context.strokeStyle = colour;
      context.fill(path);
      if (!glass) context.stroke(path); // closes the gaps between neighbours
    }
  }
}

/** Adds a polygon to a path, always with the same sense of turning, so that overlapping ones make one area. */
function trace(path, corners) {
  const ordered = areaOf(corners) < 0 ? corners : [...corners].reverse();
  ordered.forEach(([x, y], i) => (i ? path.lineTo(x, y) : path.moveTo(x, y)));
  path.closePath();
  return path;
}

/** Twice the area of a polygon; the canvas's y axis points down, so it is negative for what is counter-clockwise to the eye. */
function areaOf(corners) {
  return corners.reduce((sum, [x, y], i) => {
    const [nextX, nextY] = corners[(i + 1) % corners.length];
    return sum + x * nextY - nextX * y;
  }, 0);
}

function shade([red, green, blue, alpha], world, face) {
  const [a, b, c] = [world[face[0]], world[face[1]], world[face[face.length - 1]]], middle = world[face[2] ?? face[0]];
  let normal = cross(plus(b, a, -1), plus(c, a, -1));
  if (dot(normal, normal) < 1e-20) normal = cross(plus(middle, b, -1), plus(c, b, -1)); // a corner that two points share
  const up = unit(normal), light = .5 + .1 * up[2] + .5 * Math.max(0, dot(up, KEY_LIGHT));
  const [r, g, b2] = [red, green, blue].map((value) => Math.min(255, Math.round(255 * value * light)));
  return `rgba(${r}, ${g}, ${b2}, ${alpha})`;
}
