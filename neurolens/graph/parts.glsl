//// head
/*
${comment}
 *
 * For GLSL 3.30, GLSL ES 3.00 (with highp floats) and later. Results mean something where status is 0. A language that
 * may ignore NaN cannot promise the status of one: rays handed in must be numbers.
 */
#define ${fma}(a, b, c) ((a) * (b) + (c))
//// state

// One state: made once by ${name}_at, handed to every call. Out of its range every ray is outside the domain.
struct ${name}_state {
    bool inside;
    float c[${count}];
};

const float ${name}_nodes[${size}] = float[${size}](
    ${rows}
);

${name}_state ${name}_at(${arguments})
{
${steps}
    float feature[${features}] = float[${features}](${made});
    ${name}_state state;
    state.inside = ${inside} > 0.5;
    for (int i = 0; i < ${count}; i++) {
        float sum = 0.0;
        for (int k = 0; k < ${features}; k++) sum += ${name}_nodes[${features} * i + k] * feature[k];
        state.c[i] = sum;
    }
    return state;
}
