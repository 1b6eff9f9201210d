/* What a retina reads: the halving of `torchfovea.sensing.retina.halve` and the bilinear reading of
`torchfovea.sensing.sampling.read`, which are the definition, in C. REAL is float or double. */

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
