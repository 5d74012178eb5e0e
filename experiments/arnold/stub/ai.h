// As much of Arnold's interface as the camera node beside uses, by the names and meanings of its public documentation, so
// that the node can be compiled and called without Arnold. This is no part of Arnold; with Arnold its own headers stand here.
#pragma once

#include <cstdint>
#include <map>
#include <string>

struct AtVector2
{
    float x, y;
    AtVector2(float x = 0, float y = 0) : x(x), y(y) {}
};

struct AtVector
{
    float x, y, z;
    AtVector(float x = 0, float y = 0, float z = 0) : x(x), y(y), z(z) {}
};

struct AtRGB
{
    float r, g, b;
    AtRGB(float r = 0, float g = 0, float b = 0) : r(r), g(g), b(b) {}
    AtRGB operator*(float f) const { return AtRGB(r * f, g * f, b * f); }
};

struct AtString
{
    std::string text;
    explicit AtString(const char *text) : text(text) {}
};

struct AtNode
{
    std::map<std::string, float> numbers;
    void *own = nullptr;
};

// Points of the picture, their change a pixel, and two random numbers for the lens.
struct AtCameraInput
{
    float sx = 0, sy = 0, dsx = 0, dsy = 0, lensx = 0, lensy = 0, relative_time = 0;
};

struct AtCameraOutput
{
    AtVector origin, dir, dOdx, dOdy, dDdx, dDdy;
    AtRGB weight = AtRGB(1, 1, 1);
};

struct AtNodeMethods
{
    void (*parameters)(AtNode *);
    void (*initialize)(AtNode *);
    void (*update)(AtNode *);
    void (*finish)(AtNode *);
    void (*create_ray)(const AtNode *, const AtCameraInput &, AtCameraOutput &, uint16_t);
    bool (*reverse_ray)(const AtNode *, const AtVector &, float, AtVector2 &);
};

struct AtNodeLib
{
    const AtNodeMethods *methods;
    const char *name;
    int output_type, node_type;
    char version[16];
};

enum { AI_TYPE_UNDEFINED, AI_NODE_CAMERA };
#define AI_VERSION "stub"

#define node_parameters static void stub_parameters(AtNode *stub_node)
#define node_initialize static void stub_initialize(AtNode *node)
#define node_update static void stub_update(AtNode *node)
#define node_finish static void stub_finish(AtNode *node)
#define node_loader extern "C" bool NodeLoader(int i, AtNodeLib *node)
#define camera_create_ray \
    static void stub_create_ray(const AtNode *node, const AtCameraInput &input, AtCameraOutput &output, uint16_t tid)
#define camera_reverse_ray \
    static bool stub_reverse_ray(const AtNode *node, const AtVector &Po, float relative_time, AtVector2 &Ps)
#define AI_CAMERA_NODE_EXPORT_METHODS(tag) \
    node_parameters; \
    node_initialize; \
    node_update; \
    node_finish; \
    camera_create_ray; \
    camera_reverse_ray; \
    static const AtNodeMethods tag##_table = { \
        stub_parameters, stub_initialize, stub_update, stub_finish, stub_create_ray, stub_reverse_ray}; \
    static const AtNodeMethods *const tag = &tag##_table;

#define AiParameterFlt(name, value) stub_node->numbers[name] = value
#define AiParameterBool(name, value) stub_node->numbers[name] = value

inline void AiCameraInitialize(AtNode *) {}
inline void AiCameraUpdate(AtNode *, bool) {}
inline void AiNodeSetLocalData(AtNode *node, void *data) { node->own = data; }
inline void *AiNodeGetLocalData(const AtNode *node) { return node->own; }
inline float AiNodeGetFlt(const AtNode *node, const AtString &name) { return node->numbers.at(name.text); }
inline bool AiNodeGetBool(const AtNode *node, const AtString &name) { return node->numbers.at(name.text) != 0; }
