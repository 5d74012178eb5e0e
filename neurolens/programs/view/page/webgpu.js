// WebGPU with the calls of gl.js, but that `read` gives a promise. Rows are from below, as WebGL2 has them.
class WebGpu {
  /** Null where the browser gives no device; `fail` takes errors, which come later than the calls that make them. */
  static async made(canvas, fail) {
    const adapter = await navigator.gpu?.requestAdapter(), blends = !!adapter?.features.has("float32-blendable");
    const device = await adapter?.requestDevice({ requiredFeatures: blends ? ["float32-blendable"] : [] }).catch(() => null);
    const context = device && canvas.getContext("webgpu");
    return context ? new WebGpu(canvas, context, device, blends, fail) : null;
  }

  constructor(canvas, context, device, blends, fail) {
    Object.assign(this, { canvas, context, device, blends, name: "WebGPU", format: navigator.gpu.getPreferredCanvasFormat() });
    context.configure({ device, format: this.format, alphaMode: "opaque" });
    device.addEventListener("uncapturederror", ({ error }) => fail(error));
    device.lost.then(() => (location.search = "?gpu=webgl2")); // drivers too new or too old for WebGPU run WebGL2
    this.blank = this.target(1, 1);
  }

  program(fragment, vertex = VERTEX) {
    const { device } = this, { found, length } = uniformsOf(vertex, fragment), visibility = GPUShaderStage.VERTEX | GPUShaderStage.FRAGMENT;
    const [first, second] = [vertex, fragment].map((text, k) => device.createShaderModule({ code: wgslOf(text, found, k === 0) }));
    const textures = [...found.values()].filter((u) => u.texture).map((u) => ({ binding: u.texture, visibility, texture: { sampleType: "unfilterable-float" } }));
    const bound = device.createBindGroupLayout({ entries: [{ binding: 0, visibility, buffer: {} }, ...textures] });
    const floats = new Float32Array(length), buffer = device.createBuffer({ size: floats.byteLength, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
    return { uniforms: found, floats, wholes: new Int32Array(floats.buffer), buffer, bound, first, second, pipelines: {} };
  }

  /** The program's pipeline for targets of a format. */
  pipeline({ pipelines, bound, first, second }, formats, adds) {
    const one = { srcFactor: "one", dstFactor: "one" }, blend = adds ? { color: one, alpha: one } : undefined;
    return (pipelines[`${formats} ${adds}`] ??= this.device.createRenderPipeline({ layout: this.device.createPipelineLayout({ bindGroupLayouts: [bound] }),
      vertex: { module: first }, fragment: { module: second, targets: formats.map((format) => ({ format, blend })) } }));
  }

  target(width, height, data = null, count = 1, half = false) {
    const format = half ? "rgba16float" : "rgba32float", usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_SRC | GPUTextureUsage.COPY_DST;
    const textures = Array.from({ length: count }, () => this.device.createTexture({ size: [width, height], format, usage }));
    if (data) this.device.queue.writeTexture({ texture: textures[0] }, data, { bytesPerRow: 16 * width }, [width, height]);
    return { texture: textures[0], textures, format, width, height };
  }

  free(target) {
    for (const texture of target.textures) texture.destroy();
  }

  draw(program, values, target, window = null, vertices = 3, adds = false) {
    const { device } = this, { uniforms, floats, wholes, buffer, bound } = program, entries = [{ binding: 0, resource: { buffer } }];
    floats[0] = target ? 0 : this.canvas.height;
    for (const [name, { texture, size, at, step, whole }] of uniforms) {
      const value = values[name];
      if (value === undefined) throw Error(`uniform ${name} has no value`);
      if (texture) entries.push({ binding: texture, resource: (value ?? this.blank).texture.createView() });
      else {
        const list = typeof value === "number" ? [value] : value;
        for (let k = 0; k < list.length; k++) (whole ? wholes : floats)[at + Math.floor(k / size) * step + (k % size)] = list[k];
      }
    }
    device.queue.writeBuffer(buffer, 0, floats);
    const pipeline = this.pipeline(program, target ? target.textures.map(() => target.format) : [this.format], adds);
    this.pass(target ? target.textures : [this.context.getCurrentTexture()], "load", (pass) => {
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, device.createBindGroup({ layout: bound, entries }));
      if (window) pass.setScissorRect(...window);
      pass.draw(vertices);
    });
  }

  pass(textures, loadOp, does) {
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginRenderPass({ colorAttachments: textures.map((t) => ({ view: t.createView(), loadOp, storeOp: "store" })) });
    does(pass);
    pass.end();
    this.device.queue.submit([encoder.finish()]);
  }

  clear(target) {
    this.pass(target.textures, "clear", () => {});
  }

  fence() {
    let done = false;
    this.device.queue.onSubmittedWorkDone().then(() => (done = true));
    return () => done;
  }

  /** Of targets of 32 bits. */
  async read(target, x = 0, y = 0, width = target.width, height = target.height, which = 0) {
    const row = 256 * Math.ceil(width / 16), encoder = this.device.createCommandEncoder(); // bytes: rows are of whole 256
    const buffer = this.device.createBuffer({ size: row * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    encoder.copyTextureToBuffer({ texture: target.textures[which], origin: [x, y] }, { buffer, bytesPerRow: row }, [width, height]);
    this.device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const found = new Float32Array(4 * width * height), all = new Float32Array(buffer.getMappedRange());
    for (let k = 0; k < height; k++) found.set(all.subarray((k * row) / 4, (k * row) / 4 + 4 * width), 4 * k * width);
    buffer.destroy();
    return found;
  }
}
