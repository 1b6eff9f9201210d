/* Which observation belongs to which cell: `torchfovea.memory.association.associate`, which is the definition, in C.

One loop over the observations in place of a hundred operations on all of them: whether each can be used, the cell of
its direction by the table of `torchfovea.memory.cell_index`, whether the gate lets it pass. Then the cells that got
none ask for the nearest observation in a grid of cubes about the sphere. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <tgmath.h>

#define SLOTS 4 /* as in torchfovea.memory.cell_index */
#define BLOCK 512 /* observations at once: what is noted of them stays in the cache */
#define EDGE (2.0 / SIDE)
#define CUBES (SIDE * SIDE * SIDE)
#define SIDE 48 /* cubes along an edge of the grid: 2.4 degrees, two receptive fields of a periphery */

typedef struct { /* torchfovea.memory.cell_index.CellIndex */
    const double *vectors; /* (3, all cells) */
    const int32_t *cells; /* (rows, SLOTS) */
    const int32_t *link;
    int64_t resolution;
} Table;

typedef struct {
    int64_t sets; /* observations and cells of each follow one another */
    int64_t observations; /* of a set */
    int64_t cells;
    const REAL *direction; /* (3, all), as every array of vectors here */
    const REAL *mean;
    const REAL *covariance; /* (6, all) */
    const REAL *support;
    const uint8_t *valid;
    const REAL *centres; /* of the cells, unit vectors */
    const REAL *spacing;
    double tolerance; /* of covariances' minors */
} Look;

typedef struct { /* where directions meet the cube, in texels of the table; what is found there */
    REAL x[BLOCK], y[BLOCK], z[BLOCK], u[BLOCK], v[BLOCK], cosine[BLOCK];
    int32_t row[BLOCK], link[BLOCK], cell[BLOCK], active[BLOCK], number[BLOCK][SLOTS];
} Places;

static REAL larger(REAL a, REAL b) { return a > b ? a : b; }

static int32_t within(REAL at, int32_t size) {
    const int32_t place = (int32_t)at;
    return place < 0 ? 0 : place >= size ? size - 1 : place;
}

/* Which observations can be fused, see `torchfovea.memory.association.usable`. No comparison passes NaN. */
static void find_usable(const Look *look, int64_t all, uint8_t *restrict good) {
    const REAL tolerance = look->tolerance;
    const REAL *restrict d = look->direction, *restrict m = look->mean, *restrict c = look->covariance;
    for (int64_t i = 0; i < all; i++) {
        const REAL x = d[i], y = d[all + i], z = d[2 * all + i], square = x * x + y * y + z * z;
        const REAL xx = c[i], yy = c[3 * all + i], zz = c[5 * all + i], sum = m[i] + m[all + i] + m[2 * all + i];
        const REAL sx = 1 / sqrt(xx), sy = 1 / sqrt(yy), sz = 1 / sqrt(zz);
        const REAL xy = c[all + i] * sx * sy, xz = c[2 * all + i] * sx * sz, yz = c[4 * all + i] * sy * sz;
        const REAL minor = 1 - xy * xy, other = 1 - xz * xz, rest = yz - xy * xz;
        good[i] = (look->valid[i] != 0) & (fabs(square - 1) < (REAL)1e-3) & (fabs(sum) < (REAL)INFINITY) &
                  (xx + yy + zz < (REAL)INFINITY) & (minor > tolerance) &
                  (minor * other - rest * rest > tolerance);
    }
}

/* The rows of the table in which directions fall, as `torchfovea.memory.nearest.nearest_cell` finds them. */
static void place(const Look *look, const Table *table, int64_t set, int64_t first, int64_t count, const uint8_t *good, Places *to) {
    const int64_t all = look->sets * look->observations;
    const REAL *restrict d = look->direction + first;
    const int32_t size = (int32_t)table->resolution;
    const REAL half = (REAL)0.5 * size;
    for (int64_t i = 0; i < count; i++) {
        REAL x = good[i] ? d[i] : 1, y = good[i] ? d[all + i] : 0, z = good[i] ? d[2 * all + i] : 0;
        const REAL ax = fabs(x), ay = fabs(y), az = fabs(z), largest = larger(larger(ax, ay), az), scale = 1 / largest;
        x *= scale, y *= scale, z *= scale;
        const int on_x = ax == largest, on_y = !on_x & (ay == largest);
        const REAL major = on_x ? x : on_y ? y : z, along = on_x ? y : on_y ? z : x, across = on_x ? z : on_y ? x : y;
        const REAL u = along * half + half, v = across * half + half;
        const int32_t face = 6 * (int32_t)set + (on_x ? 0 : on_y ? 2 : 4) + (major < 0);
        to->x[i] = x, to->y[i] = y, to->z[i] = z, to->u[i] = u, to->v[i] = v;
        to->row[i] = (face * size + within(u, size)) * size + within(v, size);
    }
}

/* Follow texels that are cut into quarters to the row that counts, and read it. Level by level, so that memory answers
many at once: the table is larger than a cache. */
static void follow(const Table *table, int64_t count, Places *at) {
    const int32_t *link = table->link;
    int64_t left = 0;
    for (int64_t i = 0; i < count; i++) at->link[i] = link[at->row[i]];
    for (int64_t i = 0; i < count; i++) at->active[left] = (int32_t)i, left += at->link[i] > 0;
    for (int32_t size = 2 * (int32_t)table->resolution; left > 0; size *= 2) {
        const REAL finer = (REAL)size / table->resolution;
        int64_t more = 0;
        for (int64_t k = 0; k < left; k++) {
            const int32_t i = at->active[k];
            at->row[i] = at->link[i] + 2 * (within(at->u[i] * finer, size) & 1) + (within(at->v[i] * finer, size) & 1);
        }
        for (int64_t k = 0; k < left; k++) {
            const int32_t i = at->active[k];
            at->link[i] = link[at->row[i]];
            at->active[more] = i, more += at->link[i] > 0;
        }
        left = more;
    }
    for (int64_t i = 0; i < count; i++) memcpy(at->number[i], table->cells + (int64_t)at->row[i] * SLOTS, sizeof at->number[i]);
}

/* The cells nearest to directions, counted through all sets, and the cosines between them. */
static void find_nearest(const Table *table, int64_t cells, int64_t count, Places *at) {
    const double *px = table->vectors, *py = px + cells, *pz = py + cells;
    follow(table, count, at);
    for (int64_t i = 0; i < count; i++) {
        const int32_t *number = at->number[i];
        const REAL x = at->x[i], y = at->y[i], z = at->z[i];
        const double fx = px[number[0]], fy = py[number[0]], fz = pz[number[0]];
        REAL best = 0;
        int32_t cell = number[0];
        for (int32_t link = at->link[i];; link = table->link[-link]) { /* a row, and those chained to it, which are rare */
            for (int k = 0; k < SLOTS; k++) {
                const int32_t other = number[k];
                const REAL dx = px[other] - fx, dy = py[other] - fy, dz = pz[other] - fz, score = x * dx + y * dy + z * dz;
                cell = score > best ? other : cell;
                best = score > best ? score : best;
            }
            if (link >= 0) break;
            number = table->cells - (int64_t)link * SLOTS;
        }
        at->cell[i] = cell;
        at->cosine[i] = (x * (REAL)fx + y * (REAL)fy + z * (REAL)fz + best) / sqrt(x * x + y * y + z * z);
    }
}

/* Whether the angle of a cosine is at most a gate [rad]: the series of the cosine settles all but a few. */
static int passes(REAL cosine, REAL gate) {
    const double square = (double)gate * gate, least = 1 - square / 2;
    if (gate < 1) {
        if (cosine < least - 1e-6) return 0;
        if (cosine > least + square * square / 24 + 1e-6) return 1;
    }
    return acos(cosine > 1 ? 1 : cosine < -1 ? -1 : cosine) <= gate;
}

/* The observations of a set in cubes about the sphere: `order` lists those of cube k from begin[k] to begin[k + 1]. */
typedef struct {
    double *place; /* (count, 3), unit vectors in the order of the cubes */
    int64_t *number;
    int32_t *begin;
} Grid;

static int cube(double t) {
    const int k = (int)((t + 1) * (0.5 * SIDE));
    return k < 0 ? 0 : k >= SIDE ? SIDE - 1 : k;
}

static int fill_grid(Grid *grid, const Look *look, int64_t first, const uint8_t *good) {
    const int64_t n = look->observations, all = look->sets * n;
    int32_t *which = malloc((n + 1) * sizeof *which);
    double *unit = malloc((3 * n + 1) * sizeof *unit);
    if (!which || !unit) return free(which), free(unit), 0;
    memset(grid->begin, 0, (CUBES + 1) * sizeof *grid->begin);
    for (int64_t i = 0; i < n; i++) {
        which[i] = -1;
        if (!good[first + i]) continue;
        const REAL *d = look->direction + first + i;
        const REAL x = d[0], y = d[all], z = d[2 * all], length = sqrt(x * x + y * y + z * z);
        unit[3 * i] = x / length, unit[3 * i + 1] = y / length, unit[3 * i + 2] = z / length;
        which[i] = (cube(unit[3 * i]) * SIDE + cube(unit[3 * i + 1])) * SIDE + cube(unit[3 * i + 2]);
        grid->begin[which[i]]++;
    }
    for (int64_t k = 1; k < CUBES; k++) grid->begin[k] += grid->begin[k - 1];
    grid->begin[CUBES] = grid->begin[CUBES - 1];
    for (int64_t i = n - 1; i >= 0; i--) { /* from behind: each cube lists them in their order, and begin comes down */
        if (which[i] < 0) continue;
        const int32_t at = --grid->begin[which[i]];
        memcpy(grid->place + 3 * at, unit + 3 * i, 3 * sizeof *unit);
        grid->number[at] = i;
    }
    return free(which), free(unit), 1;
}

/* How far a coordinate is from the k-th layer of cubes. */
static double away(double t, int k) {
    const double low = k * EDGE - 1, high = low + EDGE;
    return t < low ? low - t : t > high ? t - high : 0;
}

/* The observation nearest to a place within a distance, -1 if there is none: among those within ever more of it. */
static int64_t ask_grid(const Grid *grid, const double at[3], double reach) {
    double best = reach * reach;
    int64_t found = -1;
    for (double radius = fmin(reach, EDGE / 2);; radius = fmin(reach, 2 * radius)) {
        for (int i = cube(at[0] - radius); i <= cube(at[0] + radius); i++) {
            const double dx = away(at[0], i), left = best - dx * dx;
            for (int j = cube(at[1] - radius); j <= cube(at[1] + radius); j++) {
                const double dy = away(at[1], j);
                if (dy * dy > left) continue;
                /* the cubes along the third axis follow one another */
                const int32_t *begin = grid->begin + (i * SIDE + j) * SIDE, end = begin[cube(at[2] + radius) + 1];
                for (int32_t p = begin[cube(at[2] - radius)]; p < end; p++) {
                    const double *o = grid->place + 3 * p, x = o[0] - at[0], y = o[1] - at[1], z = o[2] - at[2];
                    const double far = x * x + y * y + z * z;
                    if (far > best || (far == best && found >= 0 && grid->number[p] > found)) continue;
                    best = far, found = grid->number[p];
                }
            }
        }
        if (radius >= reach || (found >= 0 && best <= radius * radius)) return found;
    }
}

/* Each cell that took no observation of its own takes the nearest, within that one's gate; how many pairs there are. */
static int64_t fill_cells(const Look *look, const Grid *grid, int64_t set, double gate_rad, double widest, const uint8_t *taken, int64_t pairs, int64_t *observation, int64_t *cell) {
    const int64_t size = look->cells, all = look->sets * look->observations, cells = look->sets * size;
    const double reach = 2 * sin(0.5 * fmin(widest, M_PI));
    for (int64_t c = set * size; c < (set + 1) * size; c++) {
        if (taken[c]) continue;
        const REAL x = look->centres[c], y = look->centres[cells + c], z = look->centres[2 * cells + c];
        const double at[3] = {x, y, z};
        const int64_t found = ask_grid(grid, at, reach), which = set * look->observations + found;
        if (found < 0) continue;
        const REAL *d = look->direction + which, dx = d[0] - x, dy = d[all] - y, dz = d[2 * all] - z;
        const REAL gate = fmin(fmax((double)look->support[which], gate_rad), M_PI), chord = 2 * sin(gate / 2);
        if (dx * dx + dy * dy + dz * dz <= chord * chord) observation[pairs] = which, cell[pairs++] = c;
    }
    return pairs;
}

/* Pairs of observations and cells, both counted through all sets; how many, or -1 where memory runs out. */
int64_t associate(const Look *look, const Table *table, double gate_rad, double gate_spacing, int64_t fill, int64_t *observation, int64_t *cell) {
    const int64_t n = look->observations, all = look->sets * n, cells = look->sets * look->cells;
    uint8_t *good = malloc(all + 1), *taken = calloc(cells + 1, 1);
    int64_t pairs = good && taken ? 0 : -1;
    double widest = gate_rad;
    Places at;
    if (pairs == 0) find_usable(look, all, good);
    for (int64_t start = 0; start < all && pairs >= 0;) {
        const int64_t set = start / n, end = (set + 1) * n, count = end - start < BLOCK ? end - start : BLOCK;
        place(look, table, set, start, count, good + start, &at);
        find_nearest(table, cells, count, &at);
        for (int64_t i = 0; i < count; i++) {
            const REAL support = look->support[start + i];
            const REAL gate = larger((REAL)gate_spacing * look->spacing[at.cell[i]], (REAL)gate_rad);
            const int good_one = good[start + i], pair = good_one && passes(at.cosine[i], larger(gate, support));
            if (good_one && support > widest) widest = support;
            taken[at.cell[i]] |= pair;
            observation[pairs] = start + i, cell[pairs] = at.cell[i];
            pairs += pair;
        }
        start += count;
    }
    if (fill && widest > 0 && n > 0) {
        Grid grid = {malloc(3 * n * sizeof(double)), malloc(n * sizeof(int64_t)), malloc((CUBES + 1) * sizeof(int32_t))};
        const int room = grid.place && grid.number && grid.begin;
        for (int64_t set = 0; set < look->sets && pairs >= 0; set++) {
            if (!room || !fill_grid(&grid, look, set * n, good)) pairs = -1;
            else pairs = fill_cells(look, &grid, set, gate_rad, widest, taken, pairs, observation, cell);
        }
        free(grid.place), free(grid.number), free(grid.begin);
    }
    free(good), free(taken);
    return pairs;
}
