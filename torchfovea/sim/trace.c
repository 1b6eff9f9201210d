/* Where rays meet solids: `torchfovea.sim.trace.ranges` and `occluded` by the chords of `torchfovea.sim.solids.chord`,
which are the definition, in C, several rays at once in the processor's wide registers. REAL is float or double. */

#include <math.h>
#include <stdint.h>
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
    const int64_t n = group->rays, all = group->sets * n, k = group->solids, each = group->sets * k;
    for (int64_t start = 0; start < all;) {
        const int64_t set = start / n, end = (set + 1) * n, count = end - start < BLOCK ? end - start : BLOCK;
        const REAL *x = group->direction + start, *y = x + all, *z = y + all, *o = group->origin + set;
        for (int64_t j = set * k; j < (set + 1) * k; j++) {
            const REAL *c = group->centre + j, *size = group->size + j, *turn = group->turn + j;
            const int64_t sets = group->sets;
            const Solid s = {c[0] - o[0], c[each] - o[sets], c[2 * each] - o[2 * sets], size[0], size[each],
                             size[2 * each], turn[0], turn[each], group->tiny};
            if (!near(&s, x, y, z, count)) continue;
            if (shape == 0) meet_box(&s, x, y, z, count, best + start);
            else if (shape == 1) meet_cylinder(&s, x, y, z, count, best + start);
            else meet_sphere(&s, x, y, z, count, best + start);
        }
        start += count;
    }
    return 0;
}
