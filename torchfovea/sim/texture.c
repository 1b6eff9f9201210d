/* What points of textured surfaces look like: `torchfovea.sim.texture.colour`, which is the definition, in C. Always in
single precision. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#define BLOCK 64 /* points at once, in the processor's wide registers */
#define OCTAVES 3

typedef float Four __attribute__((vector_size(16)));

typedef struct { /* torchfovea.sim.volume.PeriodicVolume */
    int64_t size; /* voxels of a period along each axis; one more closes it */
    const float *values; /* (size + 1, size + 1, size + 1, 4), x fastest */
} Volume;

typedef struct {
    float turn[9]; /* from metres to periods */
    float decay, widest; /* of its coarsest octave, by the footprint's variance [m²] */
    float amplitude[OCTAVES];
} Scale;

typedef struct { /* torchfovea.sim.texture.Paint */
    int64_t geoms;
    const float *look; /* (7, geoms) */
    const float *offset; /* (3, geoms) */
    const float *centre; /* (3, geoms) */
    const float *can; /* (2, geoms) */
    const float *stripes; /* (3, geoms) */
    const float *repeat; /* (geoms,), or NULL where nothing repeats */
    int64_t scales;
    const Scale *scale; /* the last one holds the colour's noise */
    int64_t lights;
    const float *light; /* (lights, 4) */
    double ambient, sigma;
} Paint;

typedef struct { /* rows of points near each other; (rows, columns) each */
    int64_t rows, columns;
    const int32_t *geom;
    const float *place[3];
    const float *normal[3];
    const float *footprint;
} Points;

/* e to the x, to rounding: Cody and Waite's reduction, Cephes' polynomial. */
static inline float power_of_e(float x) {
    x = x > -87 ? x : -87;
    x = x < 88 ? x : 88;
    const float n = floorf(x * 1.44269504f + 0.5f), r = x - n * 0.693359375f + n * 2.12194440e-4f;
    float p = 1.9875691500e-4f;
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    const union { int32_t bits; float value; } scale = {((int32_t)n + 127) << 23};
    return (p * r * r + r + 1) * scale.value;
}

static inline Four four(const float *from) {
    Four values;
    memcpy(&values, from, sizeof values);
    return values;
}

/* What a table says of each point's thing; most neighbours lie on one. */
static void told(const float *table, const int32_t *restrict geom, int alike, int64_t count, float *restrict to) {
    const float first = table[geom[0]];
    if (alike) for (int64_t p = 0; p < count; p++) to[p] = first;
    else for (int64_t p = 0; p < count; p++) to[p] = table[geom[p]];
}

/* The four numbers of the volume at each of some points in metres, turned. */
static void look_up(const Volume *volume, const float *restrict turn, float (*restrict at)[BLOCK], int64_t count,
                    float (*restrict to)[BLOCK]) {
    const int32_t row = 4 * (volume->size + 1), floor_ = row * (volume->size + 1), last = volume->size - 1;
    const float size = volume->size;
    int32_t first[BLOCK];
    float part[3][BLOCK];
    for (int64_t p = 0; p < count; p++) {
        int32_t where = 0;
        for (int axis = 0; axis < 3; axis++) {
            const float *t = turn + 3 * axis, period = t[0] * at[0][p] + t[1] * at[1][p] + t[2] * at[2][p];
            const float place = (period - floorf(period)) * size;
            const int32_t voxel = place < last ? (int32_t)place : last; /* no number: the last */
            part[axis][p] = place - voxel;
            where += voxel * (axis == 0 ? 4 : axis == 1 ? row : floor_);
        }
        first[p] = where;
    }
    for (int64_t p = 0; p < count; p++) {
        const float *a = volume->values + first[p];
        __builtin_prefetch(a), __builtin_prefetch(a + row), __builtin_prefetch(a + floor_), __builtin_prefetch(a + floor_ + row);
    }
    for (int64_t p = 0; p < count; p++) {
        const float *a = volume->values + first[p], *b = a + row, *c = a + floor_, *d = c + row;
        const float x = part[0][p], y = part[1][p], z = part[2][p];
        const Four near_ = four(a) + x * (four(a + 4) - four(a)), far_ = four(b) + x * (four(b + 4) - four(b));
        const Four above = four(c) + x * (four(c + 4) - four(c)), beyond = four(d) + x * (four(d + 4) - four(d));
        const Four low = near_ + y * (far_ - near_), high = above + y * (beyond - above), sum = low + z * (high - low);
        for (int k = 0; k < 4; k++) to[k][p] = sum[k];
    }
}

/* Add a scale's faded octaves to their sum and its variance. */
static void add_octaves(const Scale *scale, float (*restrict noise)[BLOCK], const float *restrict spread, int64_t count,
                        float *restrict value, float *restrict power) {
    for (int64_t p = 0; p < count; p++) {
        float fade = power_of_e(spread[p] * scale->decay);
        for (int octave = OCTAVES - 1; octave >= 0; octave--) {
            const float faded = scale->amplitude[octave] * fade;
            value[p] += noise[octave][p] * faded;
            power[p] += faded * faded;
            fade *= fade, fade *= fade; /* half the wavelength, the fourth power */
        }
    }
}

/* A soft step as wide as the blur: 1 well inside. */
static inline float inside(float distance, float blur) {
    const float s = fminf(fmaxf(0.5f + distance / (2 * blur), 0), 1);
    return s * s * (3 - 2 * s);
}

/* Put a can's label on its own colour: `torchfovea.sim.texture._label` at one point. */
static void label(const Paint *paint, int32_t geom, const float *const *place, int64_t p, float footprint, float *rgb) {
    static const float white[] = {0.93f, 0.91f, 0.87f}, silver[] = {0.62f, 0.63f, 0.66f};
    const int64_t geoms = paint->geoms;
    const float *centre = paint->centre + geom, *can = paint->can + geom, *stripes = paint->stripes + geom;
    const float pi = 3.14159265f, half = can[geoms], z = place[2][p] - centre[2 * geoms], height = z / half;
    const float angle = atan2f(place[1][p] - centre[geoms], place[0][p] - centre[0]), blur = fmaxf(footprint / half, 1e-3f);
    const float wave = 0.34f * sinf(angle + 0.9f * sinf(2 * angle)), metal = inside(fabsf(height) - 0.9f, blur);
    const float wide = inside(0.13f - fabsf(height - wave), blur), narrow = inside(0.02f - fabsf(height - wave - 0.24f), blur);
    const float around = stripes[0], up = stripes[geoms], contrast = stripes[2 * geoms];
    const float periods = around / (2 * pi * can[0]), blurred = pi * (float)paint->sigma * footprint;
    const float fade = power_of_e(-2 * blurred * blurred * (periods * periods + up * up));
    const float striped = contrast > 0 ? 1 + contrast * fade * sinf(around * angle + 2 * pi * up * z) : 1;
    const float ribbon = contrast > 0 ? 0 : fmaxf(wide, narrow);
    for (int k = 0; k < 3; k++) {
        const float base = rgb[k] * striped, shown = base + ribbon * (white[k] - base);
        rgb[k] = shown + metal * (silver[k] - shown);
    }
}

/* The colours of points, (3, points). */
int64_t paint(const Volume *volume, const Paint *paint, const Points *points, float *restrict rgb) {
    const int64_t all = points->rows * points->columns, geoms = paint->geoms, last = paint->scales - 1;
    const float sigma = paint->sigma, ambient = paint->ambient;
    float look[7][BLOCK], at[3][BLOCK], spread[BLOCK], value[BLOCK], power[BLOCK], gain[BLOCK], noise[4][BLOCK], tint[4][BLOCK];
    for (int64_t row = 0; row < points->rows; row++) {
        float least = INFINITY; /* most points are too wide for the finest octaves */
        for (int64_t i = row * points->columns; i < (row + 1) * points->columns; i++) {
            const float wide = sigma * points->footprint[i] * (sigma * points->footprint[i]);
            least = wide < least ? wide : least;
        }
        for (int64_t from = 0; from < points->columns; from += BLOCK) {
            const int64_t start = row * points->columns + from;
            const int64_t count = points->columns - from < BLOCK ? points->columns - from : BLOCK;
            const int32_t *geom = points->geom + start;
            int alike = 1;
            for (int64_t p = 1; p < count; p++) alike &= geom[p] == geom[0];
            for (int k = 0; k < 7; k++) told(paint->look + k * geoms, geom, alike, count, look[k]);
            for (int axis = 0; axis < 3; axis++) {
                const float *place = points->place[axis] + start;
                float *own = at[axis];
                told(paint->offset + axis * geoms, geom, alike, count, own);
                if (!paint->repeat) for (int64_t p = 0; p < count; p++) own[p] += place[p];
                else for (int64_t p = 0; p < count; p++) {
                    const float period = paint->repeat[geom[p]], rest = fmodf(place[p], period);
                    own[p] += isfinite(period) ? rest < 0 ? rest + period : rest : place[p];
                }
            }
            for (int64_t p = 0; p < count; p++) {
                const float wide = sigma * points->footprint[start + p];
                spread[p] = wide * wide, value[p] = 0, power[p] = 0, gain[p] = ambient;
            }
            for (int64_t scale = last; scale >= 0; scale--) {
                if (scale < last && !(least < paint->scale[scale].widest)) continue;
                look_up(volume, paint->scale[scale].turn, at, count, scale < last ? noise : tint);
                add_octaves(paint->scale + scale, scale < last ? noise : tint, spread, count, value, power);
            }
            for (int64_t k = 0; k < paint->lights; k++) {
                const float *l = paint->light + 4 * k;
                for (int64_t p = 0; p < count; p++) {
                    const float *const *n = points->normal, facing = n[0][start + p] * l[0] + n[1][start + p] * l[1] + n[2][start + p] * l[2];
                    gain[p] += l[3] * (facing > 0 ? facing : 0);
                }
            }
            for (int64_t p = 0; p < count; p++) {
                const float contrast = look[6][p], mix = 0.65f / (1 + power_of_e(-3 * tint[3][p]));
                for (int k = 0; k < 3; k++) look[k][p] += mix * (look[3 + k][p] - look[k][p]);
                /* the mean of exp(noise) shrinks as octaves fade; put it back, or far walls would darken */
                gain[p] *= power_of_e(contrast * value[p] - 0.5f * contrast * contrast * power[p]);
            }
            for (int64_t p = 0; !(alike && paint->can[geom[0]] <= 0) && p < count; p++) {
                if (paint->can[geom[p]] <= 0) continue;
                float own[] = {look[0][p], look[1][p], look[2][p]};
                label(paint, geom[p], points->place, start + p, points->footprint[start + p], own);
                for (int k = 0; k < 3; k++) look[k][p] = own[k];
            }
            for (int k = 0; k < 3; k++) {
                float *restrict to = rgb + k * all + start;
                for (int64_t p = 0; p < count; p++) {
                    const float lit = look[k][p] * gain[p], lower = lit > 0 ? lit : 0;
                    to[p] = lower < 1 ? lower : 1;
                }
            }
        }
    }
    return 0;
}
