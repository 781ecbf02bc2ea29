// Turns two meshes, one left and one right of a line: WebGL 2 and nothing else. The data stands in the page (mesh_view.py).
"use strict";
const VERTEX = `#version 300 es
uniform vec3 size, middle; uniform mat3 rotation; uniform vec3 view; uniform vec2 lens;
in vec3 place, direction, color;
out vec3 at, normal, paint;
void main() {
  at = rotation * (place * size - middle) + view;      // x right, y down, z away from the eye; the radius is 1
  normal = rotation * direction;
  paint = color;
  float near = max(.01, view.z - 4.), far = view.z + 8.;
  gl_Position = vec4(at.x * lens.x, -at.y * lens.y, (at.z * (far + near) - 2. * far * near) / (far - near), at.z);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform bool facets;
in vec3 at, normal, paint;
out vec4 shown;
void main() {
  vec3 n = normalize(facets ? cross(dFdx(at), dFdy(at)) : normal);
  if (dot(n, at) > 0.) n = -n;                           // seen from behind
  float light = .1 + .84 * max(dot(n, normalize(vec3(-.62, -.62, -.48))), 0.) + .08 * max(-n.z, 0.);
  shown = vec4(pow(pow(paint, vec3(2.2)) * light, vec3(1. / 2.2)), 1.);
}`;
const LENS = 2.75;   // focal length in units of half the shorter side
const FILLED = 0.94;  // of half the canvas, by the mesh as it is seen at first
const CLAY = [214, 208, 198], NOTHING = [96, 98, 104];

for (const box of document.querySelectorAll(".viewer")) {
  show(box).catch(error => {
    box.querySelector(".loading").textContent = `The mesh cannot be shown here: ${error.message}.`;
  });
}

async function show(box) {
  const data = JSON.parse(box.querySelector("script").textContent), stage = box.querySelector(".stage");
  const canvas = box.querySelector("canvas"), slider = stage.querySelector("input");
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) throw Error("the browser has no WebGL 2");
  const program = built(gl), bytes = await unpacked(data.blob);
  const uniform = name => gl.getUniformLocation(program, name);
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.uniform3fv(uniform("size"), data.size.map(s => s / data.radius));
  gl.uniform3fv(uniform("middle"), data.middle.map(m => m / data.radius));

  let start = 0;
  const take = (Kind, count, columns) => {
    const end = start + count * columns * Kind.BYTES_PER_ELEMENT;
    return new Kind(bytes.slice(start, start = end).buffer);
  };
  const attribute = (name, numbers, kind, columns) => {
    const place = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, columns, kind, true, 0, 0);
  };
  const meshes = data.meshes.map(described => {
    const mesh = { array: gl.createVertexArray(), count: described.vertices, corners: 3 * described.faces };
    mesh.places = take(Uint16Array, described.vertices, 3);
    gl.bindVertexArray(mesh.array);
    attribute("place", mesh.places, gl.UNSIGNED_SHORT, 3);
    attribute("direction", take(Int8Array, described.vertices, 3), gl.BYTE, 3);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, take(Uint32Array, described.faces, 3), gl.STATIC_DRAW);
    return mesh;
  });
  const after = meshes[meshes.length - 1], shades = data.values.map(() => take(Uint8Array, after.count, 1));

  const state = { at: slider ? 0.5 : 0 };
  const lens = () => {      // focal lengths in units of half the width, and half the height
    const wide = canvas.clientWidth, high = canvas.clientHeight;
    return [LENS * Math.min(1, high / wide), LENS * Math.min(1, wide / high)];
  };
  const away = mesh => {    // as near as all of it can be seen from, but for what lies outside the box of data.half
    const half = data.half.map(h => 1.001 * h / data.radius), [across, down] = lens().map(f => f / FILLED);
    const rows = data.rotation.map(row => row.map((r, k) => r * data.size[k] / data.radius / 65535));
    const start = data.rotation.map(row => row.reduce((sum, r, k) => sum + r * data.middle[k] / data.radius, 0));
    let most = 0;
    for (let i = 0; i < mesh.places.length; i += 3) {
      const [x, y, z] = rows.map((r, k) => r[0] * mesh.places[i] + r[1] * mesh.places[i + 1] + r[2] * mesh.places[i + 2]
        - start[k]);
      if (Math.abs(x) <= half[0] && Math.abs(y) <= half[1] && Math.abs(z) <= half[2])
        most = Math.max(most, across * Math.abs(x) - z, down * Math.abs(y) - z);
    }
    return most;
  };
  const reset = () => {     // the meshes fill the canvas
    const rotation = data.rotation.map(row => [...row]);
    Object.assign(state, { rotation, x: 0, y: 0, away: Math.max(...meshes.map(away)), moved: false });
  };
  let waiting = 0;
  const later = () => { waiting ||= requestAnimationFrame(() => { waiting = 0; draw(); }); };
  const draw = () => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(side => Math.round(side * devicePixelRatio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.uniform2f(uniform("lens"), ...lens());
    gl.uniform3f(uniform("view"), state.x, state.y, state.away);
    gl.uniformMatrix3fv(uniform("rotation"), true, state.rotation.flat());
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0.125, 0.145, 0.184, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.SCISSOR_TEST);
    const edge = Math.round(state.at * width);
    meshes.forEach((mesh, k) => {
      const left = mesh === after ? edge : 0, right = mesh === after ? width : edge;
      gl.scissor(left, 0, right - left, height);
      gl.bindVertexArray(mesh.array);
      gl.drawElements(gl.TRIANGLES, mesh.corners, gl.UNSIGNED_INT, 0);
    });
  };
  const paint = choice => {
    meshes.forEach(mesh => {
      const colors = new Uint8Array(3 * mesh.count), value = mesh === after ? choice : -1;
      const table = value < 0 ? null : ramp(data.values[value].colors);
      for (let i = 0; i < mesh.count; i++) colors.set(table ? table[shades[value][i]] : CLAY, 3 * i);
      gl.bindVertexArray(mesh.array);
      attribute("color", colors, gl.UNSIGNED_BYTE, 3);
    });
    box.querySelectorAll("button").forEach(b => b.setAttribute("aria-pressed", +b.dataset.value === choice));
    box.querySelectorAll(".scale").forEach((scale, k) => { scale.hidden = k !== choice; });
    later();
  };

  const turn = (across, down) => {    // about the eye's own axes
    const [ca, sa, cd, sd] = [Math.cos(across), Math.sin(across), Math.cos(down), Math.sin(down)];
    const spin = [[ca, 0, -sa], [-sd * sa, cd, -sd * ca], [cd * sa, sd, cd * ca]];
    state.moved = true;
    state.rotation = spin.map(row => [0, 1, 2].map(k => row.reduce((sum, s, j) => sum + s * state.rotation[j][k], 0)));
  };
  const zoom = by => { state.moved = true; state.away = Math.min(20, Math.max(0.15, state.away * by)); };
  const shift = (x, y) => {
    const unit = 2 * state.away / LENS / Math.min(canvas.clientWidth, canvas.clientHeight);
    state.moved = true; state.x += x * unit; state.y += y * unit;
  };
  const fingers = new Map();
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus();
    fingers.set(event.pointerId, event);
  });
  canvas.addEventListener("pointermove", event => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const x = event.clientX - last.clientX, y = event.clientY - last.clientY;
    if (fingers.size === 2) {
      const other = [...fingers.values()].find(finger => finger.pointerId !== event.pointerId);
      const apart = finger => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
      zoom(Math.max(1, apart(last)) / Math.max(1, apart(event)));
      shift(x / 2, y / 2);
    } else if (event.buttons & 2 || event.shiftKey) shift(x, y);
    else turn(x * 0.008, y * 0.008);
    fingers.set(event.pointerId, event);
    later();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", event => {
    if (document.activeElement !== canvas) return;      // else the page scrolls
    event.preventDefault();
    zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.0015));
    later();
  }, { passive: false });
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("dblclick", () => { reset(); later(); });
  canvas.addEventListener("keydown", event => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    if (step) turn(...step);
    else if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 0.9 : 1.1);
    else return;
    event.preventDefault();
    later();
  });
  if (slider) slider.addEventListener("input", () => {
    state.at = slider.value / 100;
    stage.style.setProperty("--at", slider.value + "%");
    later();
  });
  box.querySelectorAll("button").forEach(b => b.addEventListener("click", () => paint(+b.dataset.value)));
  box.querySelector("[type=checkbox]").addEventListener("change", event => {
    gl.uniform1i(uniform("facets"), event.target.checked);
    later();
  });
  new ResizeObserver(() => { if (!state.moved) reset(); later(); }).observe(canvas);
  reset();
  paint(-1);
  draw();
  box.querySelector(".loading").remove();
  box.draw = draw;
}

function built(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw Error(gl.getProgramInfoLog(program));
  return program;
}

async function unpacked(text) {
  const packed = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function ramp(anchors) {
  const table = Array.from({ length: 255 }, (_, i) => {
    const at = i / 254 * (anchors.length - 1), low = Math.min(Math.floor(at), anchors.length - 2);
    return anchors[low].map((c, k) => Math.round(c + (at - low) * (anchors[low + 1][k] - c)));
  });
  return [...table, NOTHING];
}
