// Draw one scan with WebGL 2.
//
// A browser without a GPU needs up to seconds for a picture, and at each frame the page waits until its canvas is drawn. So
// the picture is drawn beside the canvas, and copied to the canvas after it is finished.
"use strict";

const ATTRIBUTES = { position: 0, intensity: 1, disagreement: 2, label: 3, truth: 4, uncertain: 5 };
const RINGS = [10, 20, 30, 40, 50], SIDES = 180;  // the radii of the rings on the ground, metres, and their corners
// The most pixels of the canvas. For smooth edges, it has up to twice the window's resolution.
const MAX_PIXELS = 6e6;
const POLL = 4;  // the time between two questions whether the GPU has finished, milliseconds
const PATIENCE = 5000;  // the longest time to wait for the GPU, milliseconds

class Drawing {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false, alpha: true });
    if (!gl) throw new Error("This page draws with WebGL 2, which this browser does not offer.");
    this.gl = gl;
    this.canvas = canvas;
    this.points = this.program(POINT_SHADER, POINT_COLOR);
    this.lines = this.program(RING_SHADER, RING_COLOR);
    this.screen = this.program(SCREEN_SHADER, SCREEN_COLOR);
    this.classes = this.texture(0, new Uint8Array(4 * 256));
    this.ramp = this.texture(1, new Uint8Array(4 * 256));
    this.uploaded = new Map();
    this.empty = gl.createVertexArray();
    this.makeRings();
    this.makeTarget();
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  texture(unit, bytes) {
    const gl = this.gl, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    if (bytes) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Fill a texture with 256 RGBA colours. */
  fill(unit, bytes) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  }

  makeRings() {
    const gl = this.gl, corners = [];
    for (const radius of RINGS) {
      for (let side = 0; side < SIDES; side++) {
        const angle = (2 * Math.PI * side) / SIDES;
        corners.push(radius * Math.cos(angle), radius * Math.sin(angle), about.ground);
      }
    }
    corners.push(-2, 0, about.ground, 4, 0, about.ground, 0, -2, about.ground, 0, 2, about.ground);
    this.rings = gl.createVertexArray();
    gl.bindVertexArray(this.rings);
    this.buffer(new Float32Array(corners));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  }

  buffer(values) {
    const gl = this.gl, buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    return buffer;
  }

  /** Make textures for the points, so that a shader can read their depth, and the picture that the shader draws. */
  makeTarget() {
    const gl = this.gl;
    this.colors = this.texture(2, null);
    this.depths = this.texture(3, null);
    this.target = gl.createFramebuffer();
    this.picture = gl.createFramebuffer();
    this.pixels = gl.createRenderbuffer();
  }

  resize() {
    const gl = this.gl, { clientWidth, clientHeight } = this.canvas;
    const finer = Math.sqrt(MAX_PIXELS / Math.max(clientWidth * clientHeight, 1));
    const ratio = Math.min(Math.max(window.devicePixelRatio || 1, finer), 2);
    const width = Math.max(1, Math.round(clientWidth * ratio)), height = Math.max(1, Math.round(clientHeight * ratio));
    this.ratio = ratio;
    if (this.width === width && this.height === height) return;
    Object.assign(this, { width, height });
    gl.activeTexture(gl.TEXTURE2);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.activeTexture(gl.TEXTURE3);
    gl.texImage2D(
      gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null,
    );
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.colors, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.depths, 0);
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.pixels);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.picture);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, this.pixels);
  }

  /** Return the buffers of a scan; they are made when it is first drawn. */
  buffersOf(scan) {
    if (!this.uploaded.has(scan.index)) {
      const buffers = { position: this.buffer(scan.positions) };
      for (const [name, plane] of Object.entries(scan.planes)) buffers[name] = this.buffer(plane);
      this.uploaded.set(scan.index, buffers);
    }
    return this.uploaded.get(scan.index);
  }

  /** Upload the new values of a plane, such as corrected labels. */
  refresh(scan, name) {
    const buffers = this.buffersOf(scan);
    if (buffers[name]) this.gl.deleteBuffer(buffers[name]);
    buffers[name] = this.buffer(scan.planes[name]);
  }

  /** Bind the planes of a scan to the shader's attributes; the values of a missing plane are 0. */
  bind(scan, labels) {
    const gl = this.gl, buffers = this.buffersOf(scan);
    gl.bindVertexArray(this.empty);
    for (const [name, place] of Object.entries(ATTRIBUTES)) {
      const buffer = buffers[name === "label" ? labels : name];
      if (!buffer) {
        gl.disableVertexAttribArray(place);
        if (place >= ATTRIBUTES.label) gl.vertexAttribI4ui(place, 0, 0, 0, 0);
        else gl.vertexAttrib1f(place, 0);
        continue;
      }
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(place);
      if (place === 0) gl.vertexAttribPointer(0, 3, gl.SHORT, false, 0, 0);
      else if (place >= ATTRIBUTES.label) gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_BYTE, 0, 0);
      else gl.vertexAttribPointer(place, 1, gl.UNSIGNED_BYTE, true, 0, 0);
    }
  }

  /** Let the GPU draw the picture; `matrix` is then the matrix from metres to its clip space. */
  draw(scan, look, camera) {
    const gl = this.gl;
    this.resize();
    this.matrix = camera.matrix(this.width / this.height);
    gl.viewport(0, 0, this.width, this.height);
    this.drawPoints(scan, look);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.picture);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    if (look.rings) this.drawRings();
    this.drawScreen(look, camera);
  }

  /** Wait until the picture is finished, while the page goes on. */
  async finished() {
    const gl = this.gl, sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), end = performance.now() + PATIENCE;
    const isDrawing = () => !gl.isContextLost() && gl.getSyncParameter(sync, gl.SYNC_STATUS) === gl.UNSIGNALED;
    gl.flush();
    do await new Promise((resolve) => setTimeout(resolve, POLL));
    while (isDrawing() && performance.now() < end);
    gl.deleteSync(sync);
  }

  /** Copy the picture to the canvas. */
  present() {
    const { gl, canvas, width, height } = this;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.picture);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  drawPoints(scan, look) {
    const gl = this.gl, { program, places } = this.points;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(program);
    this.bind(scan, look.labels);
    this.fill(0, look.classColors());
    this.fill(1, look.rampColors());
    gl.uniformMatrix4fv(places.matrix, false, this.matrix);
    gl.uniform3fv(places.center, scan.center);
    gl.uniform3fv(places.unit, scan.step);
    gl.uniform2fv(places.range, look.range());
    gl.uniform3fv(places.low, look.box.slice(0, 3));
    gl.uniform3fv(places.high, look.box.slice(3));
    for (const [name, color] of Object.entries(about.marks)) gl.uniform3fv(places[name], color.map((part) => part / 255));
    gl.uniform1f(places.size, (look.size * this.height) / (2 * FIELD));
    gl.uniform1f(places.smallest, 1.4 * this.ratio * Math.max(1, look.size));
    gl.uniform1i(places.mode, MODES.indexOf(look.color));
    gl.uniform1i(places.only, ONLY.indexOf(look.only));
    gl.uniform1i(places.classes, 0);
    gl.uniform1i(places.ramp, 1);
    gl.drawArrays(gl.POINTS, 0, scan.count);
  }

  drawRings() {
    const gl = this.gl, { program, places } = this.lines;
    gl.useProgram(program);
    gl.bindVertexArray(this.rings);
    gl.uniformMatrix4fv(places.matrix, false, this.matrix);
    gl.uniform1f(places.strength, 0.13);
    RINGS.forEach((radius, place) => gl.drawArrays(gl.LINE_LOOP, place * SIDES, SIDES));
    gl.uniform1f(places.strength, 0.4);
    gl.drawArrays(gl.LINES, RINGS.length * SIDES, 4);
  }

  drawScreen(look, camera) {
    const gl = this.gl, { program, places } = this.screen;
    gl.useProgram(program);
    gl.bindVertexArray(this.empty);
    for (const place of Object.values(ATTRIBUTES)) gl.disableVertexAttribArray(place);
    gl.uniform1i(places.colors, 2);
    gl.uniform1i(places.depths, 3);
    gl.uniform1f(places.near, camera.near);
    gl.uniform1f(places.far, camera.far);
    gl.uniform1f(places.strength, look.shading ? 0.9 : 0);
    gl.uniform1f(places.reach, 1.5 * this.ratio);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
