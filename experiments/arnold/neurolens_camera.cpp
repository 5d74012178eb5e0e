// A camera node of Arnold around a whole camera of neurolens: see docs/pages/how-to/karma-arnold.md.
//
//   neurolens export MODEL --to c --whole-camera --focus 2 --f-number 2 --derivatives --name lens -o lens.h
//   g++ -O3 -march=native -fPIC -shared -I. -I$ARNOLD/include neurolens_camera.cpp -o neurolens_camera.so -L$ARNOLD/bin -lai
//
// Focus, stop and zoom are those of lens.h; the film is as wide as Arnold's screen window, from -1 to 1. The camera's frame
// is Arnold's: it looks along -z, with y up. Lengths are metres times `units_per_m`, positions count from the film.

#include <ai.h>

#include <cmath>
#include <cstdint>
#include <cstring>

#include "lens.h"

AI_CAMERA_NODE_EXPORT_METHODS(NeurolensCameraMethods)

namespace
{
struct Settings
{
    float units_per_m;
    bool dispersion;
};

const float HALF_WIDTH_MM = 0.5f * LENS_FILM_WIDTH_MM;
const float REFERENCE_NM = 587.56f, SHORTEST_NM = 400.0f, LONGEST_NM = 700.0f;

uint32_t bits_of(float x)
{
    uint32_t bits;
    std::memcpy(&bits, &x, sizeof bits);
    return bits;
}

uint32_t mixed(uint32_t x)
{
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    return x ^ (x >> 16);
}

// A third random number, which Arnold does not give: of the point on the picture and the lens sample.
float third(const AtCameraInput &input)
{
    const uint32_t of_lens = mixed(bits_of(input.lensx) ^ mixed(bits_of(input.lensy)));
    const uint32_t all = mixed(of_lens ^ mixed(bits_of(input.sx) ^ mixed(bits_of(input.sy))));
    return float(all >> 8) / 16777216.0f;
}

AtVector scaled(float x, float y, float z, float by)
{
    return AtVector(x * by, y * by, z * by);
}
}

node_parameters
{
    AiParameterFlt("units_per_m", 1.0f);
    AiParameterBool("dispersion", true);
}

node_initialize
{
    AiCameraInitialize(node);
    AiNodeSetLocalData(node, new Settings());
}

node_update
{
    Settings *settings = static_cast<Settings *>(AiNodeGetLocalData(node));
    settings->units_per_m = AiNodeGetFlt(node, AtString("units_per_m"));
    settings->dispersion = AiNodeGetBool(node, AtString("dispersion"));
    AiCameraUpdate(node, false);
}

node_finish
{
    delete static_cast<Settings *>(AiNodeGetLocalData(node));
}

camera_create_ray
{
    (void)tid;
    const Settings *settings = static_cast<const Settings *>(AiNodeGetLocalData(node));
    // From long waves to short ones; red, green and blue weigh Bernstein's polynomials, each of mean 1.
    const float part = third(input), rest = 1.0f - part;
    const bool colours = settings->dispersion;
    const float nanometres = colours ? LONGEST_NM + part * (SHORTEST_NM - LONGEST_NM) : REFERENCE_NM;
    // The picture on the film stands on its head.
    const float film_x = -HALF_WIDTH_MM * input.sx, film_y = -HALF_WIDTH_MM * input.sy;
    const lens_ray ray = lens(film_x, film_y, input.lensx, input.lensy, nanometres);
    if (ray.status != 0)
    {
        output.origin = AtVector(0, 0, 0);
        output.dir = AtVector(0, 0, -1);
        output.weight = AtRGB(0, 0, 0);
        return;
    }
    const float units = settings->units_per_m;
    output.origin = scaled(ray.x_m, ray.y_m, ray.z_m, units);
    output.dir = AtVector(ray.dx, ray.dy, ray.dz);
    // Film millimetres a pixel: one pixel moves the film point by this along each axis.
    const float along_x = -HALF_WIDTH_MM * input.dsx, along_y = -HALF_WIDTH_MM * input.dsy;
    output.dOdx = scaled(ray.x_mm_by_film_x_mm, ray.y_mm_by_film_x_mm, ray.z_mm_by_film_x_mm, along_x * units);
    output.dOdy = scaled(ray.x_mm_by_film_y_mm, ray.y_mm_by_film_y_mm, ray.z_mm_by_film_y_mm, along_y * units);
    output.dDdx = scaled(ray.dx_by_film_x_mm, ray.dy_by_film_x_mm, ray.dz_by_film_x_mm, along_x);
    output.dDdy = scaled(ray.dx_by_film_y_mm, ray.dy_by_film_y_mm, ray.dz_by_film_y_mm, along_y);
    const AtRGB colour = colours ? AtRGB(3 * rest * rest, 6 * part * rest, 3 * part * part) : AtRGB(1, 1, 1);
    output.weight = colour * ray.weight;
}

// Where a point of the camera's space is in the picture, by its focal length alone: Arnold subdivides by it.
camera_reverse_ray
{
    (void)node;
    (void)relative_time;
    if (Po.z >= 0.0f)
        return false;
    const float scale = LENS_EFL_MM / HALF_WIDTH_MM / -Po.z;
    Ps = AtVector2(Po.x * scale, Po.y * scale);
    return true;
}

node_loader
{
    if (i != 0)
        return false;
    node->methods = NeurolensCameraMethods;
    node->output_type = AI_TYPE_UNDEFINED;
    node->name = "neurolens_camera";
    node->node_type = AI_NODE_CAMERA;
    std::strncpy(node->version, AI_VERSION, sizeof node->version);
    return true;
}
