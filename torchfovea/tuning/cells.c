/* The draws of `torchfovea.tuning.cells.draw_cells`, which is the definition, in C: each slot stops at its first within
reach. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <tgmath.h>

#include "../sensing/head.h"

typedef struct { /* torchfovea.tuning.bias.Bias */
    int64_t mixtures, components; /* one for all scenes, or one for each */
    const REAL *edges; /* of the components' shares, (mixtures, components) */
    const REAL *means; /* (mixtures, components, 3) */
    const REAL *factors; /* (mixtures, components, 3, 3) */
} Mixtures;

typedef struct {
    int64_t count, cells; /* slots, and how many a scene has */
    const int64_t *slots;
    int64_t first, last; /* draws of each, the last one not included */
    REAL *direction; /* (count, 3) */
    uint8_t *good; /* whether a draw was within reach, (count,) */
} Slots;

static void uniform(uint64_t seed, uint64_t counter, REAL to[2]) {
    uint64_t x = (seed * 0x632BE59BD9B4E019u + counter) * 0x9E3779B97F4A7C15u;
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9u;
    x = (x ^ (x >> 27)) * 0x94D049BB133111EBu;
    x ^= x >> 31;
    to[0] = ((REAL)(x & 0xFFFFFFFFu) + (REAL)0.5) / (REAL)4294967296.0;
    to[1] = ((REAL)(x >> 32) + (REAL)0.5) / (REAL)4294967296.0;
}

int64_t draw_cells(const Mixtures *from, const Head *given, int64_t seed, const Slots *of) {
    const Head head = *given;
    const int64_t m = from->components;
    for (int64_t k = 0; k < of->count; k++) {
        const int64_t slot = of->slots[k], set = from->mixtures > 1 ? slot / of->cells : 0;
        REAL *to = of->direction + 3 * k;
        of->good[k] = 0;
        for (int64_t j = of->first; j < of->last && !of->good[k]; j++) {
            const uint64_t counter = ((uint64_t)slot << 20) + (uint64_t)j;
            REAL lot[2], one[2], two[2];
            int64_t c = 0;
            if (m > 1) {
                uniform((uint64_t)seed + 1, counter, lot);
                for (int64_t i = 0; i < m; i++) c += lot[0] > from->edges[set * m + i];
                c = c < m ? c : m - 1;
            }
            uniform((uint64_t)seed + 2, counter, one), uniform((uint64_t)seed + 3, counter, two);
            const REAL turn = (REAL)6.283185307179586477, radius = sqrt(-2 * log(one[0]));
            const REAL a = radius * cos(turn * one[1]), b = radius * sin(turn * one[1]);
            const REAL d = sqrt(-2 * log(two[0])) * cos(turn * two[1]);
            const REAL *mean = from->means + 3 * (set * m + c), *f = from->factors + 9 * (set * m + c);
            const REAL x = mean[0] + (f[0] * a + f[1] * b + f[2] * d), y = mean[1] + (f[3] * a + f[4] * b + f[5] * d);
            const REAL z = mean[2] + (f[6] * a + f[7] * b + f[8] * d);
            const REAL length = larger(sqrt(x * x + y * y + z * z), (REAL)1e-12);
            if (!can_fixate(&head, x / length, y / length, z / length)) continue;
            to[0] = x / length, to[1] = y / length, to[2] = z / length, of->good[k] = 1;
        }
    }
    return 0;
}
