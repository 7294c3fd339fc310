// The paper's MPC in a browser: MuJoCo steps models/quadrotor.xml, the exported C controllers fly it.
import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { LineMaterial } from 'three/addons/lines/LineMaterial.js';
import { LineSegments2 } from 'three/addons/lines/LineSegments2.js';
import { LineSegmentsGeometry } from 'three/addons/lines/LineSegmentsGeometry.js';
import loadMujoco from '@mujoco/mujoco';
import mujocoBinary from './mujoco.wasm.gz';
import constrainedBinary from './constrained.wasm.gz';
import unconstrainedBinary from './unconstrained.wasm.gz';
import robustBinary from './robust.wasm.gz';
import xml from './quadrotor.xml';
import facts from './facts.json';

const BINARIES = { constrained: constrainedBinary, unconstrained: unconstrainedBinary, robust: robustBinary };
const STATUS = ['Optimum, no bound active', 'Optimum, tilt bounds active', 'Optimum, rotor bounds active',
  'No optimum: clipped command', 'No optimum: last plan', 'No optimum: last command'];
const NO_OPTIMUM = 3; // least status without an optimum
const DEG = 180 / Math.PI;
const PULL = { stiffness: 12, damping: 3, most: 40, point: [0, 0, 0.005] }; // N/m, N s/m, N, m above the centre of mass
const PUSH = { force: 40, steps: 200, point: [0, 0, 0.01] }; // N, ms, m
const clip = (value, least, most) => Math.min(Math.max(value, least), most);

// ---- the flight -----------------------------------------------------------------------------------------------------

const unzip = (bytes) =>
  new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'))).arrayBuffer();

/** An exported controller; its memory never grows, so that these views stay valid. */
async function loadController(name) {
  const { start, horizon, memory, widen, reset, step, changes } =
    (await WebAssembly.instantiate(await unzip(BINARIES[name]))).instance.exports;
  const first = start();
  const view = (from, count) => new Float64Array(memory.buffer, first + 8 * from, count);
  return { name, horizon: horizon(), widen, reset, step, changes,
    state: view(0, 12), acting: view(12, 4), command: view(16, 4), reference: view(20, 4 * horizon()) };
}

/** Roll, pitch, yaw [rad] of a unit quaternion, as quadsim.rotation computes them. */
function toEuler([w, x, y, z]) {
  return [Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), Math.asin(clip(2 * (w * y - z * x), -1, 1)),
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))];
}

/** The vehicle, the reference that it follows, and the controller that flies it. */
class Flight {
  constructor(mj, controllers) {
    this.mj = mj;
    this.model = mj.MjModel.from_xml_string(xml);
    this.data = new mj.MjData(this.model);
    for (const stage of ['SENSOR', 'CONSTRAINT', 'CONTACT', 'SPRING', 'DAMPER']) // without effect on a free body
      this.model.opt.disableflags |= mj.mjtDisableBit[`mjDSBL_${stage}`].value;
    this.controllers = controllers;
    this.controller = controllers.constrained;
    this.following = 'course';
    this.tilt = facts.tilt; // bound on roll and pitch [deg]
    this.reset();
  }

  reset() {
    const { mj, model, data } = this;
    mj.mj_resetData(model, data);
    data.qpos.set([...facts.position, Math.cos(facts.yaw / 2), 0, 0, Math.sin(facts.yaw / 2)]);
    mj.mj_forward(model, data);
    Object.assign(this, { k: 0, substep: 0, status: 0, refused: 0, lost: null, pull: null, push: null, spent: 0 });
    this.acting = Array(4).fill(facts.hover);
    this.slew = [0, 0, 0, 0];
    this.lastYaw = this.uprightYaw = facts.yaw;
    this.euler = [0, 0, facts.yaw];
    this.target = [0, 0, 2];
    this.filtered = this.filter([...facts.position, 0], 0);
    this.use(this.controller.name);
  }

  /** Let a controller take over from the next period on. */
  use(name) {
    this.controller = this.controllers[name];
    this.controller.acting.set(this.acting);
    this.controller.reset();
    this.worst = Array(4).fill(Infinity);
  }

  bound(degrees) {
    this.tilt = degrees;
    this.worst = Array(4).fill(Infinity);
    for (const controller of Object.values(this.controllers)) controller.widen((degrees - facts.tilt) / DEG);
  }

  follow(what) {
    if (what === 'target' && this.following === 'course') {
      this.target = this.filtered.slice(0, 3);
      this.target[2] = Math.max(this.target[2], 1);
    }
    this.following = what;
  }

  /** The reference of a period before its filter: x, y, z, yaw. */
  desired(k) {
    if (this.following === 'target') return [...this.target, 0];
    const lap = k % (facts.end + 200); // again after a rest that is longer than any preview
    const inside = ([start, stop]) => lap > start && lap < stop;
    return [...facts.windows.map((windows, i) => windows.find(inside)?.[2] ?? facts.position[i]), 0];
  }

  /** The reference's next row after `last`.  Eq. (31). */
  filter(last, k) { return this.desired(k).map((value, i) => value + facts.keep * (last[i] - value)); }

  /** The paper's 12 states; the yaw counts its turns as quadsim.state.YawTurns does. */
  state() {
    const q = this.data.qpos, v = this.data.qvel; // views on memory that may grow: never kept
    const [roll, pitch, wrapped] = toEuler(q.slice(3));
    const upright = Math.cos(roll) * Math.cos(pitch) >= 0;
    const turns = Math.round(((upright ? this.uprightYaw : this.lastYaw) - wrapped) / (2 * Math.PI));
    const yaw = (this.lastYaw = wrapped + 2 * Math.PI * turns);
    if (upright) this.uprightYaw = yaw;
    const lateral = v[4] * Math.sin(roll) + v[5] * Math.cos(roll); // of body rates, as Euler-angle rates follow
    return [q[0], v[0], q[1], v[1], q[2], v[2], roll, v[3] + lateral * Math.tan(pitch),
      pitch, v[4] * Math.cos(roll) - v[5] * Math.sin(roll), yaw, lateral / Math.cos(pitch)];
  }

  /** Start a control period: measure, compute the command, hold it. */
  control() {
    const c = this.controller;
    c.state.set((this.measured = this.state()));
    c.acting.set(this.acting);
    let row = this.filtered;
    for (let i = 0; i < c.horizon; i++) c.reference.set((row = this.filter(row, this.k + i + 1)), 4 * i);
    const started = performance.now();
    this.status = c.step();
    if (this.k) this.spent += performance.now() - started; // the first starts without an active set
    this.refused += this.status >= NO_OPTIMUM;
    const command = Array.from(c.command, (speed) => Math.max(speed, 0));
    this.slew = command.map((speed, i) => speed - this.acting[i]);
    this.acting = command;
    this.data.ctrl.set(command.map((speed) => facts.thrust * speed * speed));
  }

  /** One physics step; the controller is called where a period starts. */
  step() {
    if (this.substep === 0) this.control();
    this.applyForces();
    this.mj.mj_step(this.model, this.data);
    const q = this.data.qpos;
    this.euler = toEuler(q.slice(3));
    this.margins().forEach((margin, i) => (this.worst[i] = Math.min(this.worst[i], margin)));
    this.substep = (this.substep + 1) % facts.steps;
    if (this.substep) return;
    this.k += 1;
    this.filtered = this.filter(this.filtered, this.k);
    if (Math.cos(this.euler[0]) * Math.cos(this.euler[1]) < 0) this.lost = 'It turned over';
    else if (q[2] < -0.1) this.lost = 'It hit the ground';
    else if (!(Math.hypot(q[0], q[1], q[2]) < 150)) this.lost = 'It flew away';
  }

  /** Distances to the nearest bounds: roll, pitch [deg], rotor speeds, their steps [rad/s]. */
  margins() {
    const within = ([least, most], values) => Math.min(...values.map((value) => Math.min(value - least, most - value)));
    return [this.tilt - DEG * Math.abs(this.euler[0]), this.tilt - DEG * Math.abs(this.euler[1]),
      within(facts.speed, this.acting), within(facts.slew, this.slew)];
  }

  /** The visitor's pull, a spring to the pointer, and push. */
  applyForces() {
    const q = this.data.qpos, v = this.data.qvel;
    const force = new THREE.Vector3(), torque = new THREE.Vector3();
    const apply = (newtons, point) => {
      const lever = new THREE.Vector3(...point).applyQuaternion(new THREE.Quaternion(q[4], q[5], q[6], q[3]));
      force.add(newtons);
      torque.add(lever.cross(newtons));
    };
    if (this.pull) {
      const spring = this.pull.to.map((to, i) => PULL.stiffness * (to - q[i]) - PULL.damping * v[i]);
      apply((this.pull.force = new THREE.Vector3(...spring).clampLength(0, PULL.most)), PULL.point);
    }
    if (this.push && this.push.left-- > 0) apply(this.push.force, PUSH.point);
    this.data.xfrc_applied.set([...force, ...torque], 6); // of body 1, world axes
  }
}

// ---- the view -------------------------------------------------------------------------------------------------------

const FLOOR = -0.132, TRAIL = 1200;
const theme = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

class Stage {
  constructor(canvas, flight) {
    THREE.Object3D.DEFAULT_UP.set(0, 0, 1);
    Object.assign(this, { canvas, flight, scene: new THREE.Scene() });
    this.camera = new THREE.PerspectiveCamera(42, 1, 0.05, 500);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.scene.fog = new THREE.Fog(0, 15, 90);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: true, enablePan: false, minDistance: 1, maxDistance: 50,
      maxPolarAngle: 1.6 });
    this.light();
    this.vehicle = this.draw(flight);
    this.mark();
    this.paint();
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.paint());
    this.resize();
    this.camera.position.set(-2.6, -3.6, 1.7);
  }

  light() {
    this.sky = new THREE.HemisphereLight(0xf2f7ff, 0x9aa3ab);
    this.sun = new THREE.DirectionalLight(0xfff1dc);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    Object.assign(this.sun.shadow.camera, { left: -1.1, right: 1.1, top: 1.1, bottom: -1.1, near: 1, far: 60 });
    this.sun.shadow.bias = -0.0006;
    const canvas = Object.assign(document.createElement('canvas'), { width: 256, height: 256 });
    const pen = canvas.getContext('2d'), wrap = THREE.RepeatWrapping;
    for (const i of [0, 1, 2, 3]) {
      pen.fillStyle = i % 3 ? '#b3bec8' : '#bfc9d1';
      pen.fillRect(128 * (i % 2), 128 * (i >> 1), 128, 128);
    }
    Object.assign(pen, { strokeStyle: '#dbe3ea', lineWidth: 2 });
    for (const at of [0, 128, 256]) pen.strokeRect(at, -9, 256, 999), pen.strokeRect(-9, at, 999, 256);
    const map = new THREE.CanvasTexture(canvas);
    Object.assign(map, { colorSpace: THREE.SRGBColorSpace, wrapS: wrap, wrapT: wrap, anisotropy: 8 });
    map.repeat.set(200, 200); // tiles of 1 m
    this.floor = new THREE.Mesh(new THREE.PlaneGeometry(400, 400), new THREE.MeshLambertMaterial({ map }));
    this.floor.position.z = FLOOR;
    this.floor.receiveShadow = true;
    this.scene.add(this.sky, this.sun, this.sun.target, this.floor);
  }

  /** The vehicle's geoms as MuJoCo compiled them. */
  draw({ mj, model, data }) {
    const group = new THREE.Group(), kind = mj.mjtGeom;
    this.discs = [];
    this.blades = [];
    mj.mj_resetData(model, data);
    mj.mj_kinematics(model, data); // at the origin, level: poses in the body's frame
    for (let g = 0; g < model.ngeom; g++) {
      if (model.geom_bodyid[g] === 0) continue;
      const [a, b, c] = model.geom_size.slice(3 * g), type = model.geom_type[g];
      const shape = type === kind.mjGEOM_SPHERE.value ? new THREE.SphereGeometry(a, 24, 16)
        : type === kind.mjGEOM_ELLIPSOID.value ? new THREE.SphereGeometry(1, 32, 20).scale(a, b, c)
        : type === kind.mjGEOM_CAPSULE.value ? new THREE.CapsuleGeometry(a, 2 * b, 6, 16).rotateX(Math.PI / 2)
        : type === kind.mjGEOM_CYLINDER.value ? new THREE.CylinderGeometry(a, a, 2 * b, 40).rotateX(Math.PI / 2)
        : new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
      const [red, green, blue, opacity] = model.mat_rgba.slice(4 * model.geom_matid[g]);
      const color = new THREE.Color().setRGB(red, green, blue, THREE.SRGBColorSpace);
      const mesh = new THREE.Mesh(shape, new THREE.MeshStandardMaterial({ color, opacity, roughness: 0.45,
        metalness: 0.1, transparent: opacity < 1, depthWrite: opacity === 1 }));
      const m = data.geom_xmat.slice(9 * g), p = data.geom_xpos.slice(3 * g), holder = new THREE.Group();
      new THREE.Matrix4().set(m[0], m[1], m[2], p[0], m[3], m[4], m[5], p[1], m[6], m[7], m[8], p[2], 0, 0, 0, 1)
        .decompose(holder.position, holder.quaternion, holder.scale);
      mesh.castShadow = true;
      if (opacity < 1) (opacity < 0.5 ? this.discs : this.blades).push(mesh);
      group.add(holder.add(mesh));
    }
    this.scene.add(group);
    this.flight.reset();
    return group;
  }

  /** Course, trail, preview, target, and the visitor's force. */
  mark() {
    const lines = (count, linewidth, opacity) => {
      const material = new LineMaterial({ linewidth, opacity, transparent: true });
      const line = new LineSegments2(new LineSegmentsGeometry(), material);
      line.geometry.setPositions(new Float32Array(6 * count));
      line.frustumCulled = false;
      this.scene.add(line);
      return line;
    };
    this.course = lines(facts.end / 2, 2, 0.6);
    let last = [...facts.position, 0];
    for (let k = 0; k <= facts.end; k++) { // every other segment: dashes
      const row = this.flight.filter(last, k);
      if (k % 2) segment(this.course, k >> 1, last, row);
      last = row;
    }
    this.trail = lines(TRAIL, 3, 0.9);
    this.preview = lines(100, 4, 1);
    this.force = lines(1, 4, 1);
    const mesh = (geometry) => {
      const part = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.85 }));
      this.scene.add(part);
      return part;
    };
    this.tip = mesh(new THREE.ConeGeometry(0.045, 0.13, 20));
    this.ring = mesh(new THREE.TorusGeometry(0.55, 0.018, 12, 64));
    const post = () => mesh(new THREE.CylinderGeometry(0.006, 0.006, 1, 8).rotateX(Math.PI / 2).translate(0, 0, 0.5));
    [this.post, this.drop] = [post(), post()];
    this.foot = mesh(new THREE.RingGeometry(0.2, 0.235, 48));
    this.clear();
  }

  /** Colours of the page's theme. */
  paint() {
    const colours = { flown: [this.trail, this.drop, this.foot], disturbance: [this.force, this.tip],
      reference: [this.course, this.preview, this.ring, this.post], floor: [this.floor] };
    for (const [name, parts] of Object.entries(colours)) for (const part of parts) part.material.color.set(theme(name));
    this.scene.fog.color.set(theme('horizon'));
    this.sky.intensity = 2 * theme('light');
    this.sun.intensity = 1.8 * theme('light');
  }

  clear() {
    this.laid = 0;
    this.lastPoint = null;
    this.trail.geometry.instanceCount = 0;
  }

  /** One more segment of the trail; the oldest give way. */
  lay(point) {
    if (this.lastPoint) segment(this.trail, this.laid++ % TRAIL, this.lastPoint, point);
    this.trail.geometry.instanceCount = Math.min(this.laid, TRAIL);
    this.lastPoint = point;
  }

  show(seconds) {
    const { flight, vehicle, controls, camera } = this, q = flight.data.qpos;
    vehicle.position.set(q[0], q[1], q[2]);
    vehicle.quaternion.set(q[4], q[5], q[6], q[3]);
    camera.position.add(vehicle.position).sub(controls.target); // it goes along
    controls.target.copy(vehicle.position);
    controls.update();
    const turn = 0.3 * Math.min(seconds, 0.05);
    this.blades.forEach((blade, i) => (blade.rotation.z += (i % 2 ? -turn : turn) * flight.acting[i]));
    this.discs.forEach((disc, i) => { // where a rotor or its step is at a bound
      const [, most] = facts.speed, [down, up] = facts.slew, near = 0.01;
      const active = flight.acting[i] > most - near || flight.slew[i] > up - near || flight.slew[i] < down + near;
      disc.material.color.lerp(new THREE.Color(active ? theme('warning') : 0x596b85), 0.2);
    });
    this.sun.target.position.copy(vehicle.position);
    this.sun.position.copy(vehicle.position).add(new THREE.Vector3(4, -3, 18));
    const [x, y, z] = flight.desired(flight.k + 1);
    this.ring.position.set(x, y, z);
    this.foot.position.set(q[0], q[1], FLOOR + 0.006);
    for (const [post, at] of [[this.post, this.ring.position], [this.drop, vehicle.position]]) {
      post.position.set(at.x, at.y, FLOOR);
      post.scale.z = Math.max(at.z - FLOOR, 0.01);
    }
    this.course.visible = flight.following === 'course';
    const { reference, horizon } = flight.controller;
    for (let i = 0; i + 1 < horizon; i++)
      segment(this.preview, i, reference.subarray(4 * i), reference.subarray(4 * i + 4));
    this.preview.geometry.instanceCount = horizon - 1;
    const force = flight.pull?.force ?? (flight.push?.left > 0 ? flight.push.force : null);
    this.force.visible = this.tip.visible = Boolean(force);
    if (force) {
      const end = flight.pull ? flight.pull.to : vehicle.position.clone().addScaledVector(force, 0.03).toArray();
      segment(this.force, 0, q, end);
      this.tip.position.set(...end);
      this.tip.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), force.clone().normalize());
    }
    this.renderer.render(this.scene, camera);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }
}

function segment(line, i, from, to) {
  const buffer = line.geometry.attributes.instanceStart.data;
  buffer.array.set([from[0], from[1], from[2], to[0], to[1], to[2]], 6 * i);
  buffer.needsUpdate = true;
}

/** Drag the vehicle by a spring, or the target's ring: upright facing the camera, level when seen from above. */
function dragging(stage, flight, grabbed) {
  const { canvas, camera, controls } = stage;
  const ray = new THREE.Raycaster(), plane = new THREE.Plane(), hit = new THREE.Vector3(), offset = new THREE.Vector3();
  let dragged = null, pointer = null;
  const aim = (event) => {
    const box = canvas.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width, y = (event.clientY - box.top) / box.height;
    ray.setFromCamera(new THREE.Vector2(2 * x - 1, 1 - 2 * y), camera);
  };
  const under = (event) => {
    aim(event);
    const near = ({ position }, radius) =>
      ray.ray.distanceToPoint(position) < radius * Math.max(1, camera.position.distanceTo(position) / 7);
    return near(stage.vehicle, 0.26) ? stage.vehicle : near(stage.ring, 0.65) ? stage.ring : null;
  };
  canvas.addEventListener('pointerdown', (event) => {
    dragged = under(event);
    if (!dragged) return;
    controls.enabled = false;
    canvas.setPointerCapture(event.pointerId);
    pointer = event;
    const at = dragged.position.clone();
    if (dragged === stage.vehicle) return void (flight.pull = { to: at.toArray(), force: new THREE.Vector3() });
    const normal = camera.getWorldDirection(new THREE.Vector3());
    plane.setFromNormalAndCoplanarPoint(normal.z < -0.6 ? normal.set(0, 0, 1) : normal.setZ(0).normalize(), at);
    offset.set(0, 0, 0);
    if (ray.ray.intersectPlane(plane, hit)) offset.copy(at).sub(hit);
    grabbed(at.toArray());
  }, { capture: true });
  canvas.addEventListener('pointermove', (event) => {
    if (!dragged) return void (canvas.style.cursor = under(event) ? 'pointer' : '');
    pointer = event;
    aim(event);
    if (dragged === stage.vehicle || !ray.ray.intersectPlane(plane, hit)) return;
    hit.add(offset);
    flight.target = [clip(hit.x, -20, 20), clip(hit.y, -20, 20), clip(hit.z, 0.3, 15)];
  });
  for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, () => {
    dragged = flight.pull = null;
    controls.enabled = true;
  });
  return () => { // every frame, as the camera goes along with the vehicle
    if (!flight.pull || !pointer) return;
    aim(pointer);
    plane.setFromNormalAndCoplanarPoint(camera.getWorldDirection(new THREE.Vector3()), stage.vehicle.position);
    if (ray.ray.intersectPlane(plane, hit)) flight.pull.to = hit.toArray();
  };
}

// ---- the instruments ------------------------------------------------------------------------------------------------

const $ = (id) => document.getElementById(id);
const setText = (node, text) => { if (node.textContent !== text) node.textContent = text; };
const signed = (value, digits) => value.toFixed(digits).replace(/^-(0\.?0*)$/, '$1').replace('-', '−');
const span = ([least, most]) => (most - least) / 2;
const MARGINS = [['roll', '°', 2], ['pitch', '°', 2], ['speed', ' rad/s', 0], ['slew', ' rad/s', 1]];
const HISTORY = 400; // periods

class Panel {
  constructor() {
    this.rows = MARGINS.map(([name]) => {
      const row = $('margins').insertRow();
      row.innerHTML = `<th>${name}</th><td class="bar"><div><i></i></div></td>
        <td class="now"></td><td class="worst"></td>`;
      return row;
    });
    this.history = [];
  }

  show(flight, factor) {
    const margins = flight.margins(), full = [flight.tilt, flight.tilt, span(facts.speed), span(facts.slew)];
    const slack = [facts.tolerance, facts.tolerance, 1e-6, 1e-6]; // as in the scenario's constraints
    this.rows.forEach((row, i) => {
      const [, unit, digits] = MARGINS[i], share = clip(margins[i] / full[i], -1, 1);
      const [now, worst] = row.querySelectorAll('.now, .worst');
      const state = margins[i] < -slack[i] ? 'over' : share < 0.02 ? 'near' : '';
      row.className = state;
      row.querySelector('i').style.transform = `scaleX(${state ? Math.max(Math.abs(share), 0.02) : share})`;
      setText(now, signed(margins[i], digits) + unit);
      setText(worst, Number.isFinite(flight.worst[i]) ? signed(flight.worst[i], digits) + unit : '');
      worst.classList.toggle('over', flight.worst[i] < -slack[i]);
    });
    $('status').className = flight.status >= NO_OPTIMUM ? 'bad' : '';
    setText($('status'), flight.controller.name === 'unconstrained' ? 'Optimum without bounds' : STATUS[flight.status]);
    setText($('count'), `${flight.refused} of ${flight.k} periods without an optimum`);
    const answer = (flight.spent / Math.max(flight.k, 1)).toFixed(2);
    setText($('foot'),
      `${(flight.k * facts.period).toFixed(1)} s · ${factor.toFixed(2)}× real time · solve ${answer} ms`);
    this.plot(flight.tilt);
  }

  plot(bound) {
    const canvas = $('plot'), pen = canvas.getContext('2d'), ratio = devicePixelRatio;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio))
      Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    const most = clip(Math.max(1.4 * bound, ...this.history.flat().map((angle) => 1.1 * Math.abs(angle))), 7, 90);
    const y = (value) => height / 2 - (value / most) * (height / 2 - 1);
    const draw = (colour, points) => {
      pen.strokeStyle = theme(colour);
      pen.beginPath();
      points.forEach(([x, angle]) => pen.lineTo(x, y(angle)));
      pen.stroke();
    };
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.fillStyle = theme('zone');
    pen.fillRect(0, y(bound), width, y(-bound) - y(bound));
    pen.lineWidth = 1.6;
    for (const [i, colour] of [[0, 'flown'], [1, 'second']])
      draw(colour, this.history.map((row, k) => [(width * (k + HISTORY - this.history.length)) / HISTORY, row[i]]));
    pen.lineWidth = 1;
    pen.setLineDash([4, 3]);
    for (const sign of [-1, 1]) draw('bound', [[0, sign * bound], [width, sign * bound]]);
    pen.setLineDash([]);
    pen.fillStyle = theme('dim');
    for (const [sign, baseline] of [['', 'bottom'], ['−', 'top']]) {
      pen.textBaseline = baseline;
      pen.fillText(`${sign}${bound}°`, 2, y(sign ? -bound : bound));
    }
  }
}

// ---- the page -------------------------------------------------------------------------------------------------------

function say(title, text, ended) {
  const message = $('message');
  message.querySelector('h2').textContent = title;
  message.querySelector('p').textContent = text;
  message.querySelector('button').hidden = !ended;
  message.hidden = false;
}

function start(flight) {
  const stage = new Stage($('view'), flight), panel = new Panel();
  let paused = false, last = performance.now(), debt = 0, factor = 1, second = { began: last, steps: 0 };
  const mark = () => {
    for (const name of [...Object.keys(BINARIES), 'course', 'target'])
      $(name).setAttribute('aria-pressed', [flight.controller.name, flight.following].includes(name));
    $('pause').textContent = paused ? 'Resume' : 'Pause';
    $('angle').textContent = `±${$('bound').value}°`;
  };
  const reset = () => {
    flight.reset();
    stage.clear();
    panel.history.length = 0;
    $('message').hidden = true;
  };
  const on = (id, act) => ($(id).onclick = () => (act(), mark()));
  for (const name of Object.keys(BINARIES)) on(name, () => flight.use(name));
  on('course', () => (flight.follow('course'), reset()));
  on('target', () => flight.follow('target'));
  on('pause', () => (paused = !paused));
  on('reset', reset);
  on('push', () => { // to the right as the camera sees it
    const force = new THREE.Vector3().setFromMatrixColumn(stage.camera.matrix, 0).setZ(0).setLength(PUSH.force);
    flight.push = { force, left: PUSH.steps };
  });
  $('bound').value = facts.tilt;
  $('bound').oninput = () => (flight.bound(Number($('bound').value)), mark());
  $('message').querySelector('button').onclick = reset;
  new ResizeObserver(() => stage.resize()).observe($('view'));
  const drag = dragging(stage, flight, (at) => {
    flight.follow('target');
    flight.target = at;
    mark();
  });

  const frame = (now) => {
    const seconds = clip((now - last) / 1000, 0, 0.4);
    last = now;
    drag();
    if (!paused && !flight.lost) {
      debt += seconds;
      const until = performance.now() + 40; // ms: a slow machine flies slower, it does not freeze
      for (; debt >= facts.timestep && !flight.lost && performance.now() < until; debt -= facts.timestep) {
        if (flight.substep === 0) {
          stage.lay(Array.from(flight.data.qpos.slice(0, 3)));
          if (panel.history.push([DEG * flight.euler[0], DEG * flight.euler[1]]) > HISTORY) panel.history.shift();
        }
        flight.step();
        second.steps += 1;
      }
      debt = Math.min(debt, 0.4);
    }
    if (flight.lost && $('message').hidden) say(flight.lost, flight.refused ? 'No plan within the bounds was left, and '
      + 'the fallback did not save it.' : 'The linear model predicts such angles poorly.', true);
    if (now - second.began > 1000) {
      factor = second.steps / (now - second.began);
      second = { began: now, steps: 0 };
    }
    stage.show(paused || flight.lost ? 0 : seconds);
    panel.show(flight, factor);
    requestAnimationFrame(frame);
  };
  for (const name of ['native', 'wasm']) $(name).textContent = facts[name];
  $('message').hidden = true;
  mark();
  requestAnimationFrame(frame);
  window.quadsim = { flight, stage }; // for the tests
}

async function load() {
  const mj = await loadMujoco({ wasmBinary: await unzip(mujocoBinary), locateFile: (name) => name });
  const controllers = await Promise.all(Object.keys(BINARIES).map(loadController));
  start(new Flight(mj, Object.fromEntries(controllers.map((controller) => [controller.name, controller]))));
}

load().catch((error) => {
  say('It could not start', String(error?.message ?? error));
  throw error;
});
