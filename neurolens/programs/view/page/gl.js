// WebGL2 in the few calls that the page needs; webgpu.js has the same ones.
class Gpu {
  /** Throws a sentence for the reader where something is missing. */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw Error("This browser has no WebGL2, which the pictures need.");
    if (!gl.getExtension("EXT_color_buffer_float"))
      throw Error("WebGL2 is here, but this GPU cannot draw into float textures (EXT_color_buffer_float), in which pictures add up.");
    Object.assign(this, { gl, name: "WebGL2" });
    this.blends = !!gl.getExtension("EXT_float_blend"); // into 32 bits, which software does twice as fast as into 16
    this.blank = this.target(1, 1);
    gl.bindVertexArray(gl.createVertexArray());
  }

  /** A program, over the whole viewport unless it has a vertex shader; throws with the compiler's words. */
  program(fragment, vertex = VERTEX) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, HEAD + vertex], [gl.FRAGMENT_SHADER, HEAD + fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const said = gl.getAttachedShaders(program).map((s) => gl.getShaderInfoLog(s)).join(" ");
      throw Error(`A shader was refused: ${said || gl.getProgramInfoLog(program)}`);
    }
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name, type } = gl.getActiveUniform(program, i);
      uniforms[name.replace("[0]", "")] = { place: gl.getUniformLocation(program, name), type };
    }
    return { program, uniforms };
  }

  /** Textures of floats that are drawn into at once, `data` in the first; `half` for light that adds up where `blends` is false. */
  target(width, height, data = null, count = 1, half = false) {
    const gl = this.gl, frame = gl.createFramebuffer(), textures = [];
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    for (let k = 0; k < count; k++) {
      textures.push(gl.createTexture());
      gl.bindTexture(gl.TEXTURE_2D, textures[k]);
      gl.texImage2D(gl.TEXTURE_2D, 0, half ? gl.RGBA16F : gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, k ? null : data);
      for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
      for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, textures[k], 0);
    }
    gl.drawBuffers(textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    return { texture: textures[0], textures, frame, width, height };
  }

  free(target) {
    for (const texture of target.textures) this.gl.deleteTexture(texture);
    this.gl.deleteFramebuffer(target.frame);
  }

  /** Run a program; `target` null is the canvas, `window` [x, y, width, height] the part that is drawn; `adds` to what is there. */
  draw({ program, uniforms }, values, target, window = null, vertices = 3, adds = false) {
    const gl = this.gl;
    gl.useProgram(program);
    let unit = 0;
    for (const [name, { place, type }] of Object.entries(uniforms)) {
      const value = values[name];
      if (value === undefined) throw Error(`uniform ${name} has no value`);
      if (type === gl.SAMPLER_2D) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, (value ?? this.blank).texture);
        gl.uniform1i(place, unit++);
      } else {
        const whole = [gl.INT, gl.INT_VEC2, gl.INT_VEC4, gl.BOOL].includes(type);
        const size = { [gl.FLOAT_VEC2]: 2, [gl.INT_VEC2]: 2, [gl.FLOAT_VEC3]: 3, [gl.FLOAT_VEC4]: 4, [gl.INT_VEC4]: 4 }[type] ?? 1;
        gl[`uniform${size}${whole ? "iv" : "fv"}`](place, typeof value === "number" ? [value] : value);
      }
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, target?.frame ?? null);
    const [width, height] = target ? [target.width, target.height] : [gl.drawingBufferWidth, gl.drawingBufferHeight];
    gl.viewport(0, 0, width, height);
    if (window) gl.scissor(...window);
    gl[window ? "enable" : "disable"](gl.SCISSOR_TEST);
    gl[adds ? "enable" : "disable"](gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.drawArrays(gl.TRIANGLES, 0, vertices);
  }

  /** Nothing in a target. */
  clear(target) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /** A question, whether the GPU is done with all that it has been given so far. */
  fence() {
    const { gl } = this, sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return () => {
      const done = gl.getSyncParameter(sync, gl.SYNC_STATUS) === gl.SIGNALED;
      if (done) gl.deleteSync(sync);
      return done;
    };
  }

  /** The floats of a part of a target, four a pixel, rows from below. */
  read(target, x = 0, y = 0, width = target.width, height = target.height, which = 0) {
    const gl = this.gl, data = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + which);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.FLOAT, data);
    return data;
  }
}

const VERTEX = "void main() { gl_Position = vec4(vec2(4 * ivec2(gl_VertexID & 1, gl_VertexID >> 1) - 1), 0.0, 1.0); }";
const HEAD = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n";
