/* Where rays meet solids: `torchfovea.sim.trace.ranges` and `occluded` by the chords of `torchfovea.sim.solids.chord`, and
what the pixels of `torchfovea.sim.pixels.surfaces_seen` see, which are the definition, in C, several rays at once in the
processor's wide registers. REAL is float or double; what pixels see is shaded in float. */

#include <math.h>
#include <stdint.h>
#include <string.h>
#include <tgmath.h>

#define BLOCK 64 /* rays that are tried together: where none passes a solid's bounding sphere, none is */

typedef struct { /* torchfovea.sim.solids.Group */
    int64_t sets, solids, rays; /* of a set */
    const REAL *origin; /* (3, sets), as every array of vectors here */
    const REAL *direction; /* (3, sets, rays), of unit length */
    const REAL *centre; /* (3, sets, solids) */
    const REAL *size;
    const REAL *turn; /* (2, sets, solids) */
    double tiny;
} Group;

typedef struct {
    REAL x, y, z, a, b, c, cosine, sine, tiny; /* from the rays' origin to the centre, sizes, yaw */
} Solid;

typedef struct {
    REAL entry, leave;
} Chord;

static inline REAL larger(REAL a, REAL b) { return a > b ? a : b; }

static inline REAL smaller(REAL a, REAL b) { return a < b ? a : b; }

static inline Chord both(Chord one, Chord other) {
    return (Chord){larger(one.entry, other.entry), smaller(one.leave, other.leave)};
}

static inline Chord slab(REAL middle, REAL half, REAL step, REAL tiny) {
    const REAL inverse = 1 / (fabs(step) > tiny ? step : tiny), centre = middle * inverse, reach = half * fabs(inverse);
    return (Chord){centre - reach, centre + reach};
}

static inline Chord box(const Solid *s, REAL x, REAL y, REAL z) {
    const REAL c = s->cosine, n = s->sine;
    const Chord along = slab(c * s->x + n * s->y, s->a, c * x + n * y, s->tiny);
    const Chord across = slab(c * s->y - n * s->x, s->b, c * y - n * x, s->tiny);
    return both(both(along, across), slab(s->z, s->c, z, s->tiny));
}

static inline Chord cylinder(const Solid *s, REAL x, REAL y, REAL z) {
    const REAL square = x * x + y * y, cross = x * s->y - y * s->x;
    const int upright = square <= s->tiny; /* along the axis: inside all the way, or nowhere */
    const REAL a = upright ? 1 : square, middle = upright ? 0 : (x * s->x + y * s->y) / a;
    const REAL inside = upright ? s->a * s->a - s->x * s->x - s->y * s->y : s->a * s->a * a - cross * cross;
    const REAL half = upright ? (REAL)INFINITY : sqrt(larger(inside, 0)) / a;
    const Chord round = {inside >= 0 ? middle - half : (REAL)INFINITY, middle + half};
    return both(round, slab(s->z, s->b, z, s->tiny));
}

static inline Chord sphere(const Solid *s, REAL x, REAL y, REAL z) {
    const REAL along = x * s->x + y * s->y + z * s->z;
    const REAL inside = s->a * s->a - (s->x * s->x + s->y * s->y + s->z * s->z) + along * along;
    const REAL half = sqrt(larger(inside, 0));
    return (Chord){inside >= 0 ? along - half : (REAL)INFINITY, along + half};
}

/* Lower ranges to those at which rays meet a solid; the entry, or from inside the exit, see `torchfovea.sim.solids.first`. */
#define MEET(shape)                                                                                                    \
    static void meet_##shape(const Solid *given, const REAL *restrict x, const REAL *restrict y,                       \
                             const REAL *restrict z, int64_t count, REAL *restrict best) {                             \
        const Solid s = *given;                                                                                        \
        for (int64_t i = 0; i < count; i++) {                                                                          \
            const Chord at = shape(&s, x[i], y[i], z[i]);                                                              \
            const REAL range = at.entry > 0 ? at.entry : at.leave, old = best[i];                                      \
            const int hit = (at.entry <= at.leave) & (at.leave > 0) & (range < old);                                   \
            best[i] = hit ? range : old;                                                                               \
        }                                                                                                              \
    }
MEET(box)
MEET(cylinder)
MEET(sphere)

static void meet_any(int64_t shape, const Solid *s, const REAL *x, const REAL *y, const REAL *z, int64_t count, REAL *best) {
    (shape == 0 ? meet_box : shape == 1 ? meet_cylinder : meet_sphere)(s, x, y, z, count, best);
}

/* One solid, as it is seen from the origin of a set. */
static Solid solid_of(const Group *group, int64_t j, int64_t set) {
    const int64_t each = group->sets * group->solids, sets = group->sets;
    const REAL *c = group->centre + j, *size = group->size + j, *turn = group->turn + j, *o = group->origin + set;
    return (Solid){c[0] - o[0], c[each] - o[sets], c[2 * each] - o[2 * sets], size[0], size[each],
                   size[2 * each], turn[0], turn[each], group->tiny};
}

/* Whether any of some rays passes a solid's bounding sphere, ahead; with room for rounding. */
static int near(const Solid *s, const REAL *restrict x, const REAL *restrict y, const REAL *restrict z, int64_t count) {
    const REAL square = s->x * s->x + s->y * s->y + s->z * s->z, beside = square - (s->a * s->a + s->b * s->b + s->c * s->c);
    if (!(beside > 0)) return 1;
    const REAL least = sqrt(beside) - (REAL)1e-5 * (1 + sqrt(square)), cx = s->x, cy = s->y, cz = s->z;
    int any = 0;
    for (int64_t i = 0; i < count; i++) any |= cx * x[i] + cy * y[i] + cz * z[i] >= least;
    return any;
}

/* Lower the ranges of rays (sets, rays) to where they meet solids of one shape: 0 boxes, 1 cylinders, 2 spheres. */
int64_t meet(const Group *group, int64_t shape, REAL *best) {
    const int64_t n = group->rays, all = group->sets * n, k = group->solids;
    for (int64_t start = 0; start < all;) {
        const int64_t set = start / n, end = (set + 1) * n, count = end - start < BLOCK ? end - start : BLOCK;
        const REAL *x = group->direction + start, *y = x + all, *z = y + all;
        for (int64_t j = set * k; j < (set + 1) * k; j++) {
            const Solid s = solid_of(group, j, set);
            if (near(&s, x, y, z, count)) meet_any(shape, &s, x, y, z, count, best + start);
        }
        start += count;
    }
    return 0;
}

#define FACES 6

typedef struct { /* torchfovea.sim.pixels.Pixels, and the cameras */
    int64_t eyes, tiles;
    const REAL *ray; /* (3, tiles, BLOCK) */
    const float *span; /* (tiles, BLOCK) */
    const REAL *rotation; /* (eyes, 3, 3) */
    const REAL *eye; /* (3, eyes), as are the room's middles and halves */
    const REAL *middle;
    const REAL *half;
    const uint8_t *near; /* (solids of all shapes, eyes, tiles), whether a tile may see one */
    double steepest; /* cosine of the slant at which the footprint stops growing */
} View;

enum { RANGE, PLACE, NORMAL = 4, FOOTPRINT = 7, NUMBERS }; /* what is told of a pixel */

/* `torchfovea.sim.solids.outward` at a point from the centre. */
static inline void outward(int64_t shape, const Solid *s, float x, float y, float z, float *restrict n) {
    const float a = s->a, b = s->b, c = s->cosine, sine = s->sine;
    if (shape == 2) {
        const float scale = 1 / sqrtf(x * x + y * y + z * z);
        n[0] = x * scale, n[1] = y * scale, n[2] = z * scale;
    } else if (shape == 1) {
        const float radius = sqrtf(x * x + y * y);
        const int side = radius * b >= fabsf(z) * a;
        const float scale = side ? 1 / (radius > 1e-30f ? radius : 1e-30f) : 0;
        n[0] = x * scale, n[1] = y * scale, n[2] = side ? 0 : copysignf(1, z);
    } else {
        const float u = c * x + sine * y, v = c * y - sine * x;
        const float ahead = fabsf(u) - a, beside = fabsf(v) - b, above = fabsf(z) - (float)s->c;
        const int up = (above >= ahead) & (above >= beside), across = !up & (ahead < beside);
        const float p = up | across ? 0 : copysignf(1, u), q = across ? copysignf(1, v) : 0;
        n[0] = c * p - sine * q, n[1] = sine * p + c * q, n[2] = up ? copysignf(1, z) : 0;
    }
}

/* The first surfaces of a tile: the room's, then what stands before them. */
static void see_tile(const View *view, const Group *const *groups, int64_t set, int64_t tile, float (*restrict to)[BLOCK],
                     int32_t *restrict surface) {
    const REAL *r = view->rotation + 9 * set, *ray = view->ray + tile * BLOCK;
    float *restrict range = to[RANGE], *restrict footprint = to[FOOTPRINT];
    REAL d[3][BLOCK], best[BLOCK];
    float near_[3][BLOCK], eye[3];
    for (int k = 0; k < 3; k++) {
        const REAL *x = ray, *y = x + view->tiles * BLOCK, *z = y + view->tiles * BLOCK;
        const REAL offset = view->middle[k * view->eyes + set] - view->eye[k * view->eyes + set];
        const float middle = offset, half = view->half[k * view->eyes + set];
        for (int p = 0; p < BLOCK; p++) {
            d[k][p] = r[3 * k] * x[p] + r[3 * k + 1] * y[p] + r[3 * k + 2] * z[p];
            const float step = d[k][p];
            near_[k][p] = (half + (step < 0 ? -middle : middle)) / fabsf(step);
        }
        eye[k] = view->eye[k * view->eyes + set];
    }
    for (int p = 0; p < BLOCK; p++) {
        const float x = near_[0][p], y = near_[1][p], z = near_[2][p], least = x < y ? x : y, out = least < z ? least : z;
        const int axis = x <= out ? 0 : y <= out ? 1 : 2;
        range[p] = out;
        surface[p] = 2 * axis + ((axis == 0 ? d[0][p] : axis == 1 ? d[1][p] : d[2][p]) > 0);
    }
    for (int k = 0; k < 3; k++)
        for (int p = 0; p < BLOCK; p++) to[NORMAL + k][p] = (surface[p] == 2 * k) - (surface[p] == 2 * k + 1);
    int32_t number = FACES;
    for (int shape = 0; shape < 3; shape++) {
        const int64_t solids = groups[shape]->solids;
        for (int64_t j = 0; j < solids; j++, number++) {
            if (!view->near[((number - FACES) * view->eyes + set) * view->tiles + tile]) continue;
            const Solid s = solid_of(groups[shape], set * solids + j, set);
            for (int p = 0; p < BLOCK; p++) best[p] = INFINITY;
            meet_any(shape, &s, d[0], d[1], d[2], BLOCK, best);
            for (int p = 0; p < BLOCK; p++) {
                const float here = best[p];
                if (!(here < range[p])) continue;
                range[p] = here, surface[p] = number;
                float n[3];
                outward(shape, &s, here * d[0][p] - s.x, here * d[1][p] - s.y, here * d[2][p] - s.z, n);
                for (int k = 0; k < 3; k++) to[NORMAL + k][p] = n[k];
            }
        }
    }
    for (int p = 0; p < BLOCK; p++) {
        const float slant = fabsf(d[0][p] * to[NORMAL][p] + d[1][p] * to[NORMAL + 1][p] + d[2][p] * to[NORMAL + 2][p]), least = view->steepest;
        footprint[p] = range[p] * view->span[tile * BLOCK + p] / (slant > least ? slant : least);
        for (int k = 0; k < 3; k++) to[PLACE + k][p] = eye[k] + (float)d[k][p] * range[p];
    }
}

/* What every pixel sees, (NUMBERS, eyes, tiles, BLOCK), and the number of its surface. */
int64_t see(const View *view, const Group *boxes, const Group *cylinders, const Group *spheres, float *told, int32_t *surface) {
    const Group *groups[] = {boxes, cylinders, spheres};
    const int64_t rows = view->eyes * view->tiles;
    float seen[NUMBERS][BLOCK];
    for (int64_t row = 0; row < rows; row++) {
        see_tile(view, groups, row / view->tiles, row % view->tiles, seen, surface + row * BLOCK);
        for (int k = 0; k < NUMBERS; k++) memcpy(told + (k * rows + row) * BLOCK, seen[k], sizeof seen[k]);
    }
    return 0;
}
