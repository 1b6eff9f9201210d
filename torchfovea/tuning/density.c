/* Log densities of directions under mixtures, and the gradient of a weighted sum of them:
`torchfovea.tuning.density.log_density_each`, which is the definition, in C. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <tgmath.h>

typedef struct {
    int64_t mixtures, components; /* one for all rows, or one for each */
    const REAL *whitening; /* inverse Cholesky factors, (mixtures, components, 3, 3) */
    const REAL *mean; /* whitened, (mixtures, components, 3) */
    const REAL *weight; /* logarithm of what comes before the radial part, (mixtures, components) */
    double tail; /* how far below 0 the tail formula takes over */
    int64_t depth; /* of its continued fraction */
} Mixtures;

typedef struct {
    int64_t rows, count;
    int64_t apart; /* from the directions of a row to those of the next, in directions: 0 where all have the same */
    const REAL *direction; /* unit, (…, 3) */
} Directions;

typedef struct { /* as in Mixtures, summed over directions */
    double *whitening, *mean, *weight;
} Gradient;

typedef struct {
    REAL value; /* logarithm of a component's density */
    REAL side[3], length, cosine; /* the whitened direction, of unit length, how long it was, and the mean along it */
    REAL slope; /* of the value by the cosine: the expected distance along the direction */
} Part;

static Part part(const Mixtures *of, int64_t m, const REAL *u) {
    const REAL *w = of->whitening + 9 * m, *y = of->mean + 3 * m;
    Part p;
    REAL *s = p.side;
    for (int i = 0; i < 3; i++) s[i] = w[3 * i] * u[0] + w[3 * i + 1] * u[1] + w[3 * i + 2] * u[2];
    p.length = sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    for (int i = 0; i < 3; i++) s[i] /= p.length;
    const REAL d = p.cosine = s[0] * y[0] + s[1] * y[1] + s[2] * y[2], root2pi = (REAL)2.506628274631000502;
    REAL radial;
    if (d > -of->tail) {
        const REAL a = s[1] * y[2] - s[2] * y[1], b = s[2] * y[0] - s[0] * y[2], c = s[0] * y[1] - s[1] * y[0];
        const REAL normal = exp(-d * d / 2) / root2pi, below = erfc(-d * (REAL)0.70710678118654752440) / 2;
        const REAL moment = (1 + d * d) * below + d * normal;
        radial = log(moment) - (a * a + b * b + c * c) / 2;
        p.slope = d + 2 * (d * below + normal) / moment;
    } else { /* r_n = n/(x + r_{n+1}), see torchfovea.memory.sphere.log_radial_moment */
        const REAL x = -d;
        REAL r[3] = {(REAL)0.5 * (sqrt(x * x + 4 * (of->depth + 1)) - x), 0, 0};
        for (int64_t n = of->depth; n > 0; n--) {
            const REAL fresh = n / (x + r[0]);
            r[2] = r[1], r[1] = r[0], r[0] = fresh;
        }
        radial = log(r[0] * r[1] / (x + r[0])) - log(root2pi) - (y[0] * y[0] + y[1] * y[1] + y[2] * y[2]) / 2;
        p.slope = r[2];
    }
    p.value = of->weight[m] - 3 * log(p.length) + radial;
    return p;
}

/* Values (rows, count); or, given weights (rows, count) of them, the gradient. */
int64_t density(const Mixtures *of, const Directions *at, REAL *value, const REAL *given, const Gradient *to) {
    const int64_t k = of->components;
    for (int64_t row = 0; row < at->rows; row++) {
        const int64_t first = of->mixtures > 1 ? row * k : 0;
        for (int64_t i = 0; i < at->count; i++) {
            const REAL *u = at->direction + 3 * (row * at->apart + i);
            REAL most = -INFINITY, sum = 0;
            for (int64_t m = first; m < first + k && !(given && k == 1); m++) {
                const REAL one = part(of, m, u).value;
                if (one > most) sum = sum * exp(most - one) + 1, most = one;
                else sum += exp(one - most);
            }
            const REAL all = most + log(sum);
            if (!given) {
                value[row * at->count + i] = all;
                continue;
            }
            for (int64_t m = first; m < first + k; m++) {
                const Part p = part(of, m, u);
                const double share = given[row * at->count + i] * (k == 1 ? 1 : exp(p.value - all));
                const REAL *y = of->mean + 3 * m;
                to->weight[m] += share;
                for (int j = 0; j < 3; j++) {
                    const REAL by_side = (p.slope * (y[j] - p.cosine * p.side[j]) - 3 * p.side[j]) / p.length;
                    to->mean[3 * m + j] += share * (p.slope * p.side[j] - y[j]);
                    for (int n = 0; n < 3; n++) to->whitening[9 * m + 3 * j + n] += share * by_side * u[n];
                }
            }
        }
    }
    return 0;
}
