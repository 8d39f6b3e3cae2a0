// The cloud view in WebGL 2, rotated by mouse, touch and keys.

const VERTEX = `#version 300 es
in vec3 point; in vec4 colour; uniform mat4 view; uniform float size; out vec4 shade;
void main() { gl_Position = view * vec4(point, 1.0); gl_PointSize = size / max(gl_Position.w, 0.05); shade = colour; }`;
const FRAGMENT = `#version 300 es
precision mediump float; in vec4 shade; out vec4 pixel;
void main() { pixel = shade; }`;

export class CloudView {
  private readonly gl: WebGL2RenderingContext;
  private buffers!: [WebGLBuffer, WebGLBuffer];
  private view: WebGLUniformLocation | null = null;
  private size: WebGLUniformLocation | null = null;
  private shown: [Float32Array<ArrayBuffer>, Uint8Array<ArrayBuffer>] | undefined;
  private count = 0;
  private centre = [0, 0, 1];
  private extent = 1;
  private yaw = 0.3;
  private pitch = 0.15;
  private zoom = 1;

  constructor(private readonly canvas: HTMLCanvasElement) {
    const gl = canvas.getContext("webgl2");
    if (!gl) throw new Error("the cloud view needs WebGL 2, which this browser lacks; use the pictures instead");
    this.gl = gl;
    this.setUp();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    // The programs and buffers of the old context are lost, so create them again.
    canvas.addEventListener("webglcontextrestored", () => {
      this.setUp();
      if (this.shown) this.show(...this.shown);
    });
    this.listen();
  }

  private setUp(): void {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]] as const) {
      const shader = gl.createShader(type)!;
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "point");
    gl.bindAttribLocation(program, 1, "colour");
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    this.view = gl.getUniformLocation(program, "view");
    this.size = gl.getUniformLocation(program, "size");
    this.buffers = [gl.createBuffer(), gl.createBuffer()];
  }

  /** Shows points, each in its own colour. */
  show(points: Float32Array<ArrayBuffer>, rgba: Uint8Array<ArrayBuffer>): void {
    const { gl } = this;
    this.shown = [points, rgba];
    this.count = points.length / 3;
    const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    for (let i = 0; i < points.length; i++) {
      low[i % 3] = Math.min(low[i % 3]!, points[i]!);
      high[i % 3] = Math.max(high[i % 3]!, points[i]!);
    }
    if (this.count > 0) {
      this.centre = low.map((value, axis) => (value + high[axis]!) / 2);
      this.extent = Math.max(1e-6, ...high.map((value, axis) => value - low[axis]!)) / 2;
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[0]);
    gl.bufferData(gl.ARRAY_BUFFER, points, gl.STATIC_DRAW);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.enableVertexAttribArray(0);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[1]);
    gl.bufferData(gl.ARRAY_BUFFER, rgba, gl.STATIC_DRAW);
    gl.vertexAttribPointer(1, 4, gl.UNSIGNED_BYTE, true, 0, 0);
    gl.enableVertexAttribArray(1);
    this.draw();
  }

  draw(): void {
    const { gl, canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.05, 0.06, 0.07, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.view, false, this.matrix(canvas.width / Math.max(1, canvas.height)));
    gl.uniform1f(this.size, (2.2 * canvas.height) / 480 / this.zoom * 2.2);
    gl.drawArrays(gl.POINTS, 0, this.count);
  }

  // Returns the view matrix. Points are centred, scaled by the extent, rotated, and moved away from the viewer; the
  // camera's y axis points down and its z axis away from the viewer.
  private matrix(aspect: number): Float32Array {
    const [sy, cy, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    const rows = [
      [cy, 0, sy],
      [sp * sy, cp, -sp * cy],
      [-cp * sy, sp, cp * cy],
    ].map((row) => row.map((value) => value / this.extent));
    const along = (row: number[]) => -row.reduce((sum, value, axis) => sum + value * this.centre[axis]!, 0);
    const [x, y, z] = rows as [number[], number[], number[]];
    const distance = 2.6 * this.zoom;
    const [near, far, focal] = [0.05, 20, 1.8];
    const [a, b] = [(far + near) / (far - near), (-2 * far * near) / (far - near)];
    const out: number[] = [];
    for (let column = 0; column < 4; column++) {
      const value = (row: number[], offset: number) => (column < 3 ? row[column]! : along(row) + offset);
      const depth = value(z, distance);
      out.push((focal / aspect) * value(x, 0), -focal * value(y, 0), a * depth + (column === 3 ? b : 0), depth);
    }
    return new Float32Array(out);
  }

  private turn(yaw: number, pitch: number): void {
    this.yaw += yaw;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + pitch));
    this.draw();
  }

  private zoomBy(factor: number): void {
    this.zoom = Math.max(0.1, Math.min(5, this.zoom * factor));
    this.draw();
  }

  private listen(): void {
    const { canvas } = this;
    const fingers = new Map<number, [number, number]>();
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return a && b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const apart = spread();
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 1) this.turn((event.clientX - before[0]) / 150, (event.clientY - before[1]) / 150);
      else if (apart > 0 && spread() > 0) this.zoomBy(apart / spread());
    });
    for (const end of ["pointerup", "pointercancel"] as const) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(Math.exp(event.deltaY / 500));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turns: Record<string, [number, number]> = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
      const turn = turns[event.key];
      if (turn) this.turn(...turn);
      else if (event.key === "+" || event.key === "=") this.zoomBy(0.9);
      else if (event.key === "-") this.zoomBy(1 / 0.9);
      else return;
      event.preventDefault();
    });
    new ResizeObserver(() => canvas.hidden || this.draw()).observe(canvas);
  }
}
