// What view/__init__.py wrote: characters to bytes, LZMA (raw, lc 3, lp 0, pb 0), texts as they were.
const HALF = 1024, LITERALS = 0x300; // odds of 2048; of literals after bytes of the same three high bits

function bytesOf(text) {
  const digits = new Uint8Array(127), bytes = new Uint8Array((text.length * 13) >> 4);
  for (let code = 33, k = 0; code < 127; code++) if (!"&<\\".includes(String.fromCharCode(code))) digits[code] = k++;
  let held = 0, bits = 0, n = 0;
  for (let k = 0; k < text.length; k += 2) {
    held = (held << 13) | (91 * digits[text.charCodeAt(k)] + digits[text.charCodeAt(k + 1)]);
    for (bits += 13; bits >= 8; ) bytes[n++] = held >> (bits -= 8);
  }
  return bytes;
}

/** A stream, unpacked from its start as far as is asked for. */
class Unpacked {
  constructor(text, length) {
    const odds = (n) => new Uint16Array(n).fill(HALF), lengths = () => ({ choice: odds(2), low: odds(8), middle: odds(8), high: odds(256) });
    Object.assign(this, { bytes: bytesOf(text), at: 1, range: -1 >>> 0, code: 0, out: new Uint8Array(length), n: 0, state: 0, back: [0, 0, 0, 0] });
    Object.assign(this, { literal: odds(8 * LITERALS), match: odds(12), again: odds(12), first: odds(12), second: odds(12), third: odds(12), long: odds(12),
      slot: [0, 1, 2, 3].map(() => odds(64)), far: odds(115), align: odds(16), lengths: lengths(), lengths_again: lengths() });
    for (let k = 0; k < 4; k++) this.next();
  }

  next() {
    this.code = ((this.code << 8) | this.bytes[this.at++]) >>> 0;
  }

  narrow() {
    if (this.range >= 0x1000000) return;
    this.range = (this.range << 8) >>> 0;
    this.next();
  }

  bit(odds, i) {
    const bound = (this.range >>> 11) * odds[i], bit = this.code < bound ? 0 : 1;
    if (bit) {
      this.range -= bound;
      this.code -= bound;
      odds[i] -= odds[i] >> 5;
    } else {
      this.range = bound;
      odds[i] += (2048 - odds[i]) >> 5;
    }
    this.narrow();
    return bit;
  }

  tree(odds, bits) {
    let node = 1;
    while (node < 1 << bits) node = (node << 1) | this.bit(odds, node);
    return node - (1 << bits);
  }

  /** A tree of low bits first. */
  reverse(odds, from, bits) {
    let node = 1, found = 0;
    for (let k = 0; k < bits; k++) {
      const bit = this.bit(odds, from + node);
      node = (node << 1) | bit;
      found |= bit << k;
    }
    return found;
  }

  even(bits) {
    let found = 0;
    for (let k = 0; k < bits; k++) {
      this.range >>>= 1;
      const bit = this.code < this.range ? 0 : 1;
      this.code -= bit * this.range;
      this.narrow();
      found = (found << 1) | bit;
    }
    return found;
  }

  length({ choice, low, middle, high }) {
    if (!this.bit(choice, 0)) return 2 + this.tree(low, 3);
    return this.bit(choice, 1) ? 18 + this.tree(high, 8) : 10 + this.tree(middle, 3);
  }

  distance(length) {
    const slot = this.tree(this.slot[Math.min(length - 2, 3)], 6);
    if (slot < 4) return slot;
    const bits = (slot >> 1) - 1, base = (2 | (slot & 1)) << bits;
    if (slot < 14) return base + this.reverse(this.far, base - slot, bits);
    return base + (this.even(bits - 4) << 4) + this.reverse(this.align, 0, 4);
  }

  byte() {
    const { out, n, literal, state } = this, from = LITERALS * (n ? out[n - 1] >> 5 : 0);
    let node = 1;
    for (let known = out[n - this.back[0] - 1], bit, wanted; state >= 7 && node < 256 && bit === wanted; known <<= 1) {
      wanted = (known >> 7) & 1;
      bit = this.bit(literal, from + ((1 + wanted) << 8) + node);
      node = (node << 1) | bit;
    }
    while (node < 256) node = (node << 1) | this.bit(literal, from + node);
    out[this.n++] = node;
    this.state = state < 4 ? 0 : state < 10 ? state - 3 : state - 6;
  }

  /** The first `count` bytes, and maybe more. */
  upTo(count = this.out.length) {
    const { out, back } = this;
    while (this.n < count) {
      const late = this.state < 7 ? 0 : 3;
      if (!this.bit(this.match, this.state)) {
        this.byte();
        continue;
      }
      let length = 0;
      if (!this.bit(this.again, this.state)) {
        length = this.length(this.lengths);
        back.unshift(this.distance(length));
        back.pop();
        this.state = 7 + late;
      } else {
        let which = 0;
        if (this.bit(this.first, this.state)) which = !this.bit(this.second, this.state) ? 1 : 2 + this.bit(this.third, this.state);
        else length = 1 - this.bit(this.long, this.state);
        this.state = late ? 11 : length ? 9 : 8;
        back.unshift(...back.splice(which, 1));
        length ||= this.length(this.lengths_again);
      }
      for (let k = 0; k < length; k++, this.n++) out[this.n] = out[this.n - back[0] - 1];
    }
    return out;
  }
}

/** A text whose temporaries are counted: see _counted of view/__init__.py. */
function written(text) {
  let before = 0;
  return text.split("\n").map((line) => {
    let own = null;
    return line.replace(/\x01(-?\d*)/g, (_, said) => {
      const step = said === "" ? 1 : +said;
      if (own !== null) return `t${own - step}`;
      own = before += step;
      return `t${own}`;
    });
  }).join("\n");
}

/** Steps by urgent() of graph/shading.py: first those from which the longest chain of others leads on. */
function urgent(steps) {
  const lines = steps.split("\n").slice(0, -1), numbers = lines.map((line) => line.match(/\bt\d+\b/g)), ahead = new Map(), of = (n) => ahead.get(n) ?? 0;
  for (const [own, ...given] of [...numbers].reverse()) for (const n of given) ahead.set(n, Math.max(of(n), of(own) + 1));
  return lines.map((_, k) => k).sort((a, b) => of(numbers[b][0]) - of(numbers[a][0])).map((k) => lines[k] + "\n").join("");
}

const streams = new Map(), textOf = (bytes) => new TextDecoder().decode(bytes), jsonOf = (lens, name) => JSON.parse(textOf(partOf(lens, name)));

/** A part of a lens: bytes, or the text of code. */
function partOf({ stream: [id, length], parts }, name) {
  if (!streams.has(id)) streams.set(id, new Unpacked(document.getElementById(id).textContent, length));
  const [, from, bytes, how] = parts.find(([part]) => part === name);
  const found = streams.get(id).upTo(from + bytes).slice(from, from + bytes);
  return how === 2 ? written(textOf(found)).replace(/(?:^    float t\d+ = .*\n)+/gm, urgent) : how ? written(textOf(found)) : found;
}
