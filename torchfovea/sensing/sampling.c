/* What a retina reads: the halving of `torchfovea.sensing.sampling.halve` and the bilinear reading of
`torchfovea.sensing.sampling.read`; and what is read between the rings of one, `torchfovea.sensing.retina._from_rings`.
These are the definition, in C. REAL is float or double.

Up to four channels lie side by side, so that one load brings them all. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <tgmath.h>

#define BLOCK 256 /* places at once */

typedef REAL Four __attribute__((vector_size(4 * sizeof(REAL)), aligned(sizeof(REAL))));

typedef struct {
    int64_t images, channels, height, width;
    int64_t image, plane, row; /* from one to the next, in numbers; columns follow one another */
    const REAL *values;
} Images;

typedef struct { /* coordinates from -1 to 1 between the border pixels */
    const REAL *x;
    const REAL *y;
    int64_t images, gazes, count;
    int64_t image, gaze, place; /* from one to the next, in numbers */
} Places;

typedef struct { /* torchfovea.sensing.sampling.Sampling; levels 0: all fields read the image, once */
    int64_t fields, levels, first, above;
    const REAL *blend;
} Plan;

static REAL smaller(REAL a, REAL b) { return a < b ? a : b; }

static int64_t kept(int64_t k, int64_t size) { return k < 0 ? 0 : k < size ? k : size - 1; }

static void pack(const Images *from, int64_t image, int64_t channel, int64_t channels, Four *restrict to) {
    const REAL *values = from->values + image * from->image + channel * from->plane;
    for (int64_t j = 0; j < from->height; j++) {
        const REAL *restrict a = values + j * from->row, *restrict b = a + (channels > 1) * from->plane;
        const REAL *restrict c = b + (channels > 2) * from->plane, *restrict d = c + (channels > 3) * from->plane;
        for (int64_t i = 0; i < from->width; i++) to[j * from->width + i] = (Four){a[i], b[i], c[i], d[i]};
    }
}

/* Weights (1, 3, 3, 1) / 8 along both axes at every second pixel, the border's value beyond it. Rows are `stride` and
`line` pixels apart; what is right of the result is 0. `sum` has room for a row and three more. */
static void halve(const Four *from, int64_t height, int64_t width, int64_t stride, Four *restrict to, int64_t line, Four *restrict sum) {
    const int64_t columns = (width + 1) / 2;
    for (int64_t j = 0; j < (height + 1) / 2; j++) {
        const Four *restrict a = from + kept(2 * j - 1, height) * stride, *restrict b = from + 2 * j * stride;
        const Four *restrict c = from + kept(2 * j + 1, height) * stride, *restrict d = from + kept(2 * j + 2, height) * stride;
        Four *restrict out = to + j * line;
        for (int64_t i = 0; i < width; i++) sum[i + 1] = a[i] + d[i] + (REAL)3 * (b[i] + c[i]);
        sum[0] = sum[1], sum[width + 1] = sum[width + 2] = sum[width];
        for (int64_t i = 0; i < columns; i++) out[i] = (sum[2 * i] + sum[2 * i + 3] + (REAL)3 * (sum[2 * i + 1] + sum[2 * i + 2])) * (REAL)(1.0 / 64);
        for (int64_t i = columns; i < line; i++) out[i] = (Four){0};
    }
}

/* Read some places of an image and go from what is in `to`, channels `plane` numbers apart, to that: all the way, or as
far as `blend` says. */
static void read(const Four *image, int64_t height, int64_t width, const Places *at, int64_t set, int64_t gaze, int64_t begin, int64_t end, const REAL *blend, int64_t channels, REAL *to, int64_t plane) {
    const REAL across = (REAL)0.5 * (width - 1), down = (REAL)0.5 * (height - 1), right = width - 1, low = height - 1;
    const int64_t step = at->place, place = set * at->image + gaze * at->gaze;
    const REAL *restrict xs = at->x + place, *restrict ys = at->y + place;
    int32_t first[BLOCK], beside[BLOCK], below[BLOCK];
    REAL s[BLOCK], t[BLOCK], seen[4][BLOCK];
    for (int64_t start = begin; start < end; start += BLOCK) {
        const int64_t count = end - start < BLOCK ? end - start : BLOCK;
        for (int64_t p = 0; p < count; p++) {
            const REAL far_x = (xs[(start + p) * step] + 1) * across, far_y = (ys[(start + p) * step] + 1) * down;
            /* what is no number reads the corner */
            const REAL x = smaller(far_x > 0 ? far_x : 0, right), y = smaller(far_y > 0 ? far_y : 0, low);
            const int32_t i = (int32_t)x, j = (int32_t)y;
            first[p] = j * (int32_t)width + i, s[p] = x - i, t[p] = y - j;
            beside[p] = x < right, below[p] = y < low ? (int32_t)width : 0;
        }
        for (int64_t p = 0; p < count; p++) {
            const Four *above = image + first[p], *under = above + below[p];
            const Four upper = above[0] + s[p] * (above[beside[p]] - above[0]), lower = under[0] + s[p] * (under[beside[p]] - under[0]);
            const Four value = upper + t[p] * (lower - upper);
            for (int c = 0; c < 4; c++) seen[c][p] = value[c];
        }
        for (int64_t c = 0; c < channels; c++) {
            REAL *restrict out = to + c * plane + start - begin;
            const REAL *restrict share = blend ? blend + start - begin : NULL;
            for (int64_t p = 0; p < count; p++) out[p] = share ? out[p] + share[p] * (seen[c][p] - out[p]) : seen[c][p];
        }
    }
}

/* Values (images, channels, gazes, fields). -1 where memory runs out, else 0. */
int64_t look(const Images *from, const Places *at, const Plan *plan, REAL *to) {
    const int64_t height = from->height, width = from->width, line = (width + 1) / 2, plane = at->gazes * plan->fields;
    int64_t rows = 0;
    for (int64_t level = 0, high = height; level < plan->levels; level++) rows += high = (high + 1) / 2;
    Four *image = malloc((height * width + 1) * sizeof *image), *pyramid = malloc((rows * line + 1) * sizeof *pyramid);
    Four *sum = malloc((width + 3) * sizeof *sum);
    const int room = image && pyramid && sum;
    for (int64_t k = 0; k < from->images * from->channels && room;) {
        const int64_t set = k / from->channels, channel = k % from->channels, left = from->channels - channel;
        const int64_t channels = left < 4 ? left : 4;
        pack(from, set, channel, channels, image);
        const Four *last = image;
        Four *next = pyramid;
        for (int64_t level = 0, high = height, wide = width, stride = width; level < plan->levels; level++) {
            halve(last, high, wide, stride, next, line, sum);
            last = next, high = (high + 1) / 2, wide = (wide + 1) / 2, stride = line, next += high * line;
        }
        for (int64_t gaze = 0; gaze < at->gazes; gaze++) {
            REAL *out = to + k * plane + gaze * plan->fields;
            read(image, height, width, at, set, gaze, 0, plan->above, NULL, channels, out, plane);
            if (!plan->levels) continue;
            read(pyramid, rows, line, at, set, gaze, plan->above, plan->fields, NULL, channels, out + plan->above, plane);
            read(pyramid, rows, line, at, set, gaze, plan->fields, at->count, plan->blend, channels, out + plan->first, plane);
        }
        k += channels;
    }
    return free(image), free(pyramid), free(sum), room ? 0 : -1;
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
