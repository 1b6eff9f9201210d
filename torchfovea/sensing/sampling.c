/* What a retina reads: the halving of `torchfovea.sensing.retina.halve` and the bilinear reading of
`torchfovea.sensing.sampling.read`; and what is read between the rings of one, `torchfovea.sensing.retina._from_rings`.
These are the definition, in C. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <tgmath.h>

#define BLOCK 256 /* places at once: what is worked out for them serves every channel */

typedef struct {
    int64_t planes, height, width;
    int64_t plane, row; /* from one to the next, in numbers */
    const REAL *image;
} Planes;

static REAL smaller(REAL a, REAL b) { return a < b ? a : b; }

static int64_t kept(int64_t k, int64_t size) { return k < 0 ? 0 : k < size ? k : size - 1; }

/* Weights (1, 3, 3, 1) / 8 along both axes at every second pixel, the border's value beyond it. The rows of the result
are `stride` numbers apart, its planes `plane`; what is right of it is 0. -1 where memory runs out, else 0. */
int64_t halve(const Planes *from, REAL *to, int64_t plane, int64_t stride) {
    const int64_t height = from->height, width = from->width, rows = (height + 1) / 2, columns = (width + 1) / 2;
    const int64_t line = from->row;
    REAL *row = malloc((width + 4) * sizeof *row);
    if (!row) return -1;
    for (int64_t k = 0; k < from->planes * rows; k++) {
        const int64_t j = k % rows;
        const REAL *image = from->image + k / rows * from->plane;
        const REAL *restrict a = image + kept(2 * j - 1, height) * line, *restrict b = image + 2 * j * line;
        const REAL *restrict c = image + kept(2 * j + 1, height) * line, *restrict d = image + kept(2 * j + 2, height) * line;
        REAL *restrict sum = row + 1, *restrict out = to + k / rows * plane + j * stride;
        for (int64_t i = 0; i < width; i++) sum[i] = a[i] + d[i] + 3 * (b[i] + c[i]);
        sum[-1] = sum[0], sum[width] = sum[width + 1] = sum[width - 1];
        for (int64_t i = 0; i < columns; i++) out[i] = (sum[2 * i - 1] + sum[2 * i + 2] + 3 * (sum[2 * i] + sum[2 * i + 1])) / 64;
        for (int64_t i = columns; i < stride; i++) out[i] = 0;
    }
    return free(row), 0;
}

typedef struct { /* coordinates from -1 to 1 between the border pixels */
    const REAL *x;
    const REAL *y;
    int64_t images, gazes, count;
    int64_t image, gaze, place; /* from one to the next, in numbers */
} Places;

/* Values (images, channels, gazes, count) of images at places, the border's beyond it. */
int64_t read_bilinear(const Planes *from, int64_t channels, const Places *at, REAL *restrict to) {
    const int64_t width = from->width, height = from->height, line = from->row;
    const REAL across = (REAL)0.5 * (width - 1), down = (REAL)0.5 * (height - 1), right = width - 1, low = height - 1;
    int32_t first[BLOCK], beside[BLOCK], below[BLOCK];
    const int32_t row = (int32_t)line;
    REAL s[BLOCK], t[BLOCK];
    for (int64_t k = 0; k < at->images * at->gazes; k++) {
        const int64_t image = k / at->gazes, gaze = k % at->gazes, step = at->place;
        const REAL *restrict xs = at->x + image * at->image + gaze * at->gaze;
        const REAL *restrict ys = at->y + image * at->image + gaze * at->gaze;
        for (int64_t start = 0; start < at->count; start += BLOCK) {
            const int64_t count = at->count - start < BLOCK ? at->count - start : BLOCK;
            for (int64_t p = 0; p < count; p++) {
                const REAL far_x = (xs[(start + p) * step] + 1) * across, far_y = (ys[(start + p) * step] + 1) * down;
                /* what is no number reads the corner */
                const REAL x = smaller(far_x > 0 ? far_x : 0, right), y = smaller(far_y > 0 ? far_y : 0, low);
                const int32_t i = (int32_t)x, j = (int32_t)y;
                first[p] = j * row + i, s[p] = x - i, t[p] = y - j;
                beside[p] = x < right, below[p] = y < low ? row : 0;
            }
            for (int64_t channel = 0; channel < channels; channel++) {
                const REAL *restrict plane = from->image + (image * channels + channel) * from->plane;
                REAL *restrict out = to + ((image * channels + channel) * at->gazes + gaze) * at->count + start;
                for (int64_t p = 0; p < count; p++) {
                    const REAL a = plane[first[p]], b = plane[first[p] + beside[p]];
                    const REAL c = plane[first[p] + below[p]], d = plane[first[p] + below[p] + beside[p]];
                    const REAL upper = a + s[p] * (b - a), lower = c + s[p] * (d - c);
                    out[p] = upper + t[p] * (lower - upper);
                }
            }
        }
    }
    return 0;
}

typedef struct { /* a log-polar retina's values, (planes, fields), and places on it, (2, count) */
    int64_t planes, fields, fovea, rings, sectors, count; /* fovea: the fields before the first ring's */
    const REAL *values;
    const REAL *places; /* [retinal px] */
    double innermost, growth; /* radius of the first ring; by which the logarithm of the next one's is larger */
} Rings;

/* Logarithm of what is at least 1 and angle of a place from 0 to 2 pi, in wide registers where single precision is enough
(Cephes' polynomials). */
static inline REAL logarithm(REAL x) {
    if (sizeof(REAL) > sizeof(float)) return log(x);
    union { float value; int32_t bits; } part = {x};
    const float whole = (part.bits - 0x3f3504f3) >> 23; /* what is left is from the root of a half to that of two */
    part.bits -= (int32_t)whole * (1 << 23);
    const float m = part.value - 1, square = m * m;
    float p = 7.0376836292e-2f;
    p = p * m - 1.1514610310e-1f, p = p * m + 1.1676998740e-1f, p = p * m - 1.2420140846e-1f, p = p * m + 1.4249322787e-1f;
    p = p * m - 1.6668057665e-1f, p = p * m + 2.0000714765e-1f, p = p * m - 2.4999993993e-1f, p = p * m + 3.3333331174e-1f;
    return p * m * square - 2.12194440e-4f * whole - 0.5f * square + m + 0.693359375f * whole;
}

static inline REAL direction(REAL x, REAL y) {
    const REAL whole = (REAL)6.283185307179586, quarter = whole / 4;
    REAL angle;
    if (sizeof(REAL) > sizeof(float)) {
        angle = atan2(fabs(y), x);
    } else {
        const float a = fabs(x), b = fabs(y), most = a > b ? a : b, ratio = most > 0 ? (a > b ? b : a) / most : 0;
        const float t = ratio > 0.41421356f ? (ratio - 1) / (ratio + 1) : ratio, z = t * t;
        float p = 8.05374449538e-2f;
        p = p * z - 1.38776856032e-1f, p = p * z + 1.99777106478e-1f, p = p * z - 3.33329491539e-1f;
        const float first = p * z * t + t + (ratio > 0.41421356f ? 0.78539816f : 0), turned = b > a ? quarter - first : first;
        angle = x < 0 ? 2 * quarter - turned : turned;
    }
    return y < 0 ? whole - angle : angle;
}

/* Values (planes, count) between the rings' fields: `torchfovea.sensing.retina._from_rings`. -1 where memory runs out. */
int64_t read_rings(const Rings *from, REAL *restrict to) {
    const int64_t sectors = from->sectors, rows = from->rings + 1, inside = !from->fovea;
    const REAL inverse = 1 / from->innermost, rate = 1 / from->growth, turn = sectors / 6.283185307179586;
    REAL *image = malloc(rows * sectors * sizeof *image), s[BLOCK], t[BLOCK];
    int32_t one[BLOCK], other[BLOCK], below[BLOCK];
    if (!image) return -1;
    for (int64_t plane = 0; plane < from->planes; plane++) {
        /* row 0 is the first ring's mean, at the centre */
        const REAL *values = from->values + plane * from->fields + from->fovea;
        double sum = 0;
        for (int64_t j = 0; j < sectors; j++) sum += values[j];
        for (int64_t j = 0; j < sectors; j++) image[j] = sum / sectors;
        for (int64_t i = 0; i < from->rings * sectors; i++) image[sectors + i] = values[i];
        for (int64_t start = 0; start < from->count; start += BLOCK) {
            const int64_t count = from->count - start < BLOCK ? from->count - start : BLOCK;
            const REAL *restrict xs = from->places + start, *restrict ys = xs + from->count;
            for (int64_t p = 0; p < count; p++) {
                const REAL away = sqrt(xs[p] * xs[p] + ys[p] * ys[p]) * inverse, out = away > 1 ? away : 1;
                const REAL row = logarithm(out) * rate + (inside ? smaller(away, 1) : 1);
                const REAL column = direction(xs[p], ys[p]) * turn - (REAL)0.5;
                const REAL y = smaller(row, from->rings), left = floor(column);
                /* what is no number is in the last sector */
                const int32_t i = (int32_t)y, j = (left >= 0) & (left < sectors) ? (int32_t)left : (int32_t)sectors - 1;
                s[p] = column - left, t[p] = y - i;
                one[p] = i * (int32_t)sectors + j;
                other[p] = i * (int32_t)sectors + (j + 1 < sectors ? j + 1 : 0);
                below[p] = i < from->rings ? (int32_t)sectors : 0;
            }
            for (int64_t p = 0; p < count; p++) {
                const REAL a = image[one[p]], b = image[other[p]], c = image[one[p] + below[p]], d = image[other[p] + below[p]];
                const REAL upper = a + s[p] * (b - a), lower = c + s[p] * (d - c);
                to[plane * from->count + start + p] = upper + t[p] * (lower - upper);
            }
        }
    }
    return free(image), 0;
}
