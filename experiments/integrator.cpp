// An integrator of its own with a camera of neurolens: rays of a lens into a few spheres, written as a PPM picture.
//
//   neurolens export models/laikin_double_gauss_50.ols-60.onnx --to c --camera --focus 1.2 --name lens -o lens_camera.h
//   c++ -O2 -I. experiments/integrator.cpp -o integrator && ./integrator 360 64 > spheres.ppm
//
// Whatever is exported under the name "lens", a model or a lens file, at any focus, stop and film, goes in here.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "lens_camera.h"

struct Vec {
    float x, y, z;
};
static Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
static float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

struct Sphere {
    Vec centre;  // metres, camera frame: the camera looks along -z, y is up
    float radius;
    Vec colour;
};
static const Sphere SPHERES[] = {
    {{-0.16f, -0.02f, -0.9f}, 0.06f, {0.9f, 0.25f, 0.2f}},  // before the focus
    {{0.0f, 0.0f, -1.2f}, 0.08f, {0.3f, 0.8f, 0.35f}},      // in focus
    {{0.35f, 0.1f, -2.5f}, 0.15f, {0.3f, 0.45f, 0.95f}},    // behind it
};
static const Vec SUN = {0.4f, 0.7f, 0.59f}, SKY = {0.35f, 0.45f, 0.6f};

static float part(Vec v, int channel) { return channel == 0 ? v.x : channel == 1 ? v.y : v.z; }

// Light that comes back along a ray: the nearest sphere's colour in a sun and a grey sky, or the sky.
static float radiance(Vec origin, Vec direction, int channel) {
    float nearest = INFINITY, found = part(SKY, channel);
    for (const Sphere &s : SPHERES) {
        const Vec to = origin - s.centre;
        const float b = dot(to, direction), d = b * b - dot(to, to) + s.radius * s.radius;
        const float t = -b - std::sqrt(d > 0.0f ? d : 0.0f);
        if (d <= 0.0f || t <= 0.0f || t >= nearest) continue;
        nearest = t;
        const Vec normal = {(to.x + t * direction.x) / s.radius, (to.y + t * direction.y) / s.radius,
                            (to.z + t * direction.z) / s.radius};
        const float sun = dot(normal, SUN);
        found = part(s.colour, channel) * (0.25f + 0.75f * (sun > 0.0f ? sun : 0.0f));
    }
    return found;
}

// The n-th point of a sequence that fills the cube of four dimensions evenly: multiples of 1 / r^k, r^5 = r + 1.
static float even(long n, int dimension) {
    const double step[4] = {0.8566748838545029, 0.733891856627126, 0.6287067210378086, 0.53859725722361};
    const float place = (float)std::fmod(0.5 + n * step[dimension], 1.0);
    return place < 1.0f ? place : 0.99999994f;
}

int main(int argc, char **argv) {
    const int width = argc > 1 ? std::atoi(argv[1]) : 180, samples = argc > 2 ? std::atoi(argv[2]) : 16;
    const int height = (int)std::lround(width * (double)LENS_FILM_HEIGHT_MM / LENS_FILM_WIDTH_MM);
    if (width < 1 || height < 1 || samples < 1) return std::fputs("integrator WIDTH SAMPLES\n", stderr), 2;
    const float wavelengths_nm[3] = {610.0f, 550.0f, 465.0f};  // each colour through its own lens
    std::vector<unsigned char> picture;
    for (int row = 0; row < height; row++)
        for (int column = 0; column < width; column++)
            for (int channel = 0; channel < 3; channel++) {
                double sum = 0.0;
                for (int k = 0; k < samples; k++) {
                    const long n = ((long)row * width + column) * samples + k;
                    // The picture on the film stands on its head.
                    const float x = (0.5f - (column + even(n, 0)) / width) * LENS_FILM_WIDTH_MM;
                    const float y = ((row + even(n, 1)) / height - 0.5f) * LENS_FILM_HEIGHT_MM;
                    const lens_ray ray = lens(x, y, even(n, 2), even(n, 3), wavelengths_nm[channel]);
                    if (ray.status != 0) continue;  // blocked: dark
                    sum += ray.weight * radiance({ray.x_m, ray.y_m, ray.z_m}, {ray.dx, ray.dy, ray.dz}, channel);
                }
                const double value = std::sqrt(sum / samples);  // a gamma of 2
                picture.push_back((unsigned char)(255.0 * (value < 1.0 ? value : 1.0) + 0.5));
            }
    std::printf("P6\n%d %d\n255\n", width, height);
    std::fwrite(picture.data(), 1, picture.size(), stdout);
    return 0;
}
