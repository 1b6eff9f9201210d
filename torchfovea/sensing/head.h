/* `torchfovea.sensing.head.can_fixate`, for the loops of several C files. REAL is float or double. */

#ifndef TORCHFOVEA_HEAD_H
#define TORCHFOVEA_HEAD_H

#include <math.h>
#include <stdint.h>
#include <tgmath.h>

typedef struct { /* torchfovea.sensing.head.Head, and sines and cosines of how far it turns */
    double up_m, forward_m, nearest_m, farthest_m;
    double pan_s, pan_c, up_s, up_c, down_s, down_c;
} Head;

static inline REAL larger(REAL a, REAL b) { return a > b ? a : b; }

/* No comparison passes NaN. */
static inline int can_fixate(const Head *head, REAL x, REAL y, REAL z) {
    const REAL up = head->up_m, forward = head->forward_m, farthest = head->farthest_m, nearest = head->nearest_m;
    const REAL most = larger(larger(fabs(x), fabs(y)), fabs(z)), less = farthest / larger(most, farthest);
    const int finite = (fabs(x) < (REAL)INFINITY) & (fabs(y) < (REAL)INFINITY) & (fabs(z) < (REAL)INFINITY);
    x *= less, y *= less, z *= less;
    const REAL square = x * x + y * y, along = square + z * z - up * up, least = larger(forward + (REAL)1e-3, (REAL)1e-3);
    const int solvable = (square > (REAL)1e-12) & (along > least * least);
    const REAL side = sqrt(square), reach = sqrt(along), sine = up * side - reach * z, cosine = reach * side + up * z;
    return finite & solvable & ((REAL)head->pan_s * x >= (REAL)head->pan_c * fabs(y)) &
           ((REAL)head->up_c * sine >= (REAL)head->up_s * cosine) &
           ((REAL)head->down_c * sine <= (REAL)head->down_s * cosine) & (reach - forward >= nearest);
}

#endif
