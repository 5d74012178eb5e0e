// Random numbers of a pixel.
uint mixed(uint number) {
    uint x = number;
    x ^= x >> 16; x *= 0x7feb352du; x ^= x >> 15; x *= 0x846ca68bu; x ^= x >> 16;
    return x;
}

uint state;

void seed_of(ivec2 pixel, uint more) { state = mixed(uint(pixel.x) * 1973u + uint(pixel.y) * 9277u * 4099u + more); }

float next() {
    state = mixed(state + 0x9e3779b9u);
    return float(state >> 8) / 16777216.0;
}
