// The view: MuJoCo's azimuth, elevation, distance and centre, moved by mouse, fingers and wheel.

/** Moves a camera back, and to the middle, until it sees all geoms where they are. */
function fitCamera({ geoms, camera }, poses) {
  const balls = geoms.filter(({ type }) => type !== "plane").map(({ body, pos, size }) => {
    const [x, y, z, , ...quat] = poses.subarray(8 * body, 8 * body + 8);
    return { at: plus([x, y, z], rotate(quat, pos)), radius: Math.hypot(...size) };
  });
  if (!balls.length) return;
  const end = (k, sign) => Math.max(...balls.map(({ at, radius }) => sign * at[k] + radius)) * sign;
  camera.center = [0, 1, 2].map((k) => (end(k, 1) + end(k, -1)) / 2);
  const seen = ({ at, radius }) => {
    const { eye, forward, tangent } = sightOf(camera), way = plus(at, eye, -1), deep = dot(way, forward);
    return Math.hypot(...plus(way, forward, -deep)) + radius < tangent * deep;
  };
  camera.distance = Math.max(...balls.map(({ radius }) => 2 * radius));
  for (let i = 0; i < 60 && !balls.every(seen); i++) camera.distance *= 1.05;
}

/** What the pictures need of a camera. */
function sightOf({ azimuth, elevation, distance, center, fovy }) {
  const [a, e] = [azimuth, elevation].map((angle) => angle * Math.PI / 180);
  const forward = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
  return { eye: plus(center, forward, -distance), forward, distance, tangent: Math.tan(fovy * Math.PI / 360) };
}

/** Returns what maps a point of the world to the tile [left, top, width, height]: [x, y, distance from the eye]. */
function projectionOf({ eye, forward, tangent }, [left, top, width, height]) {
  const view = lookAlong(eye, forward, [0, 0, 1]), zoom = height / 2 / (tangent * Math.max(1, .9 * height / width));
  return ([a, b, c]) => {
    const [x, y, z] = [0, 1, 2].map((k) => view[k] * a + view[k + 4] * b + view[k + 8] * c + view[k + 12]);
    return [left + width / 2 - zoom * x / z, top + height / 2 + zoom * y / z, -z];
  };
}

class Orbit {
  /** Calls `changed` after each move, and `picked` with the place of a click that moves nothing. */
  constructor(first, changed, picked) {
    Object.assign(this, { first, changed, picked, fingers: new Map() });
    this.reset();
  }

  reset() {
    this.camera = { ...this.first, center: [...this.first.center] };
    this.changed();
  }

  zoom(factor) {
    const { distance } = this.first;
    this.camera.distance = Math.min(8 * distance, Math.max(.12 * distance, this.camera.distance * factor));
    this.changed();
  }

  get sight() { return sightOf(this.camera); }

  turn(x, y) {
    const { camera } = this;
    camera.azimuth -= .4 * x;
    camera.elevation = Math.min(89, Math.max(-89, camera.elevation - .4 * y));
    this.changed();
  }

  /** Moves the centre with the pointer; the numbers are shares of the picture's height. */
  shift(x, y) {
    const { forward, distance, tangent } = this.sight, right = unit(cross(forward, [0, 0, 1])), up = cross(right, forward);
    const scale = 2 * tangent * distance;
    this.camera.center = plus(plus(this.camera.center, right, -x * scale), up, y * scale);
    this.changed();
  }

  listenTo(canvas) {
    const { fingers } = this;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      if (!fingers.size && this.touch?.takes(event)) return;
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY, way: 0 });
    });
    canvas.addEventListener("pointermove", (event) => this.touch?.moves(event) || this.drag(event, canvas.clientHeight));
    canvas.addEventListener("pointerup", (event) => {
      if (this.touch?.ends(event)) return;
      if (fingers.get(event.pointerId)?.way < 4 && fingers.size === 1) this.picked(event.offsetX, event.offsetY);
      fingers.delete(event.pointerId);
    });
    canvas.addEventListener("pointercancel", (event) => this.touch?.ends(event) || fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode ? 20 : 1);
      this.zoom(Math.exp(.004 * Math.min(60, Math.max(-60, pixels))));
    }, { passive: false });
  }

  drag({ pointerId, clientX, clientY, buttons, shiftKey }, height) {
    const finger = this.fingers.get(pointerId);
    if (!finger) return;
    const x = clientX - finger.x, y = clientY - finger.y, other = [...this.fingers.values()].find((one) => one !== finger);
    const apart = () => Math.hypot(finger.x - other.x, finger.y - other.y) || 1, before = other && apart();
    Object.assign(finger, { x: clientX, y: clientY, way: finger.way + Math.abs(x) + Math.abs(y) });
    if (other) {
      this.zoom(before / apart());
      this.shift(x / 2 / height, y / 2 / height);
    } else if (buttons & 6 || shiftKey) {
      this.shift(x / height, y / height);
    } else {
      this.turn(x, y);
    }
  }
}
