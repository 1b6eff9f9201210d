/* The unscented transform of pinhole eyes in inverse range: `torchfovea.sensing.triangulation.observe`, which is the
definition, in C, several receptive fields at once in the processor's wide registers. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <tgmath.h>

typedef struct {
    int64_t sets; /* receptive fields of each follow one another */
    int64_t fields; /* of a set */
    const REAL *left_px; /* (2, all), as every array of vectors here */
    const REAL *right_px;
    const REAL *left_sigma;
    const REAL *right_sigma;
    const uint8_t *valid;
    const REAL *support_px;
    const REAL *left_axes; /* of torchfovea.sensing.kinematics.Eyes, (sets, 3, 3) */
    const REAL *left_place; /* (sets, 3) */
    const REAL *right_axes;
    const REAL *right_place;
} Matches;

typedef struct {
    double focal_px, cx_px, cy_px;
} Camera;

typedef struct { /* of sigma points, see torchfovea.sensing.unscented */
    double spread, each, rest, share; /* share: of what is even, 1 - 2 each by axis, else 1 */
    double tolerance; /* of covariances' minors */
    Camera left, right;
    int64_t rotated;
} Settings;

typedef struct {
    REAL *moments; /* (9, all) */
    REAL *direction;
    REAL *support;
    uint8_t *valid;
} Observations;

typedef struct { /* torchfovea.sensing.pinhole.Form */
    REAL point[4][3][3], left[3], right[3];
} Form;

static double dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* Rays in the rig's frame, whose axes are the rows, of a place's (u, v, 1). */
static void turned(const double frame[3][3], const REAL *axes, const Camera *camera, double ray[3][3]) {
    for (int i = 0; i < 3; i++) {
        double along[3];
        for (int k = 0; k < 3; k++) along[k] = frame[i][0] * axes[k] + frame[i][1] * axes[3 + k] + frame[i][2] * axes[6 + k];
        ray[i][0] = along[0] / camera->focal_px, ray[i][1] = along[1] / camera->focal_px;
        ray[i][2] = along[2] - camera->cx_px * ray[i][0] - camera->cy_px * ray[i][1];
    }
}

/* Triangulation between two eyes as a bilinear form of the places; whether they are some distance apart. */
static int form_of(const Matches *from, const Settings *by, int64_t set, Form *to) {
    const REAL *l = from->left_place + 3 * set, *r = from->right_place + 3 * set;
    const REAL *left_axes = from->left_axes + 9 * set, *right_axes = from->right_axes + 9 * set;
    double frame[3][3], left[3][3], right[3][3], *x = frame[0], *y = frame[1], *z = frame[2];
    for (int k = 0; k < 3; k++) x[k] = (double)r[k] - l[k], z[k] = (double)left_axes[3 * k + 2] + right_axes[3 * k + 2];
    const double baseline = sqrt(dot(x, x));
    for (int k = 0; k < 3; k++) x[k] /= baseline;
    const double level = dot(z, x);
    for (int k = 0; k < 3; k++) z[k] -= level * x[k];
    const double length = sqrt(dot(z, z));
    for (int k = 0; k < 3; k++) z[k] /= length;
    y[0] = z[1] * x[2] - z[2] * x[1], y[1] = z[2] * x[0] - z[0] * x[2], y[2] = z[0] * x[1] - z[1] * x[0];
    turned(frame, left_axes, &by->left, left), turned(frame, right_axes, &by->right, right);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) { /* `torchfovea.sensing.triangulation.triangulate_rectified` */
            const double across = left[0][i] * right[2][j], back = right[0][j] * left[2][i], w = (across - back) * 2 / baseline;
            const double point[3] = {across + back, left[1][i] * right[2][j] + right[1][j] * left[2][i], 2 * left[2][i] * right[2][j]};
            for (int k = 0; k < 3; k++) {
                const double placed = frame[0][k] * point[0] + frame[1][k] * point[1] + frame[2][k] * point[2];
                to->point[k][i][j] = placed + w * ((double)l[k] + r[k]) / 2;
            }
            to->point[3][i][j] = w;
        }
        to->left[i] = left[2][i], to->right[i] = right[2][i];
    }
    return baseline > 0;
}

static inline REAL largest(REAL a, REAL b) { return fabs(a) > fabs(b) ? fabs(a) : fabs(b); }

/* `torchfovea.sensing.chart.in_tangent_frame` of the first three components, times a scale; the fourth stays. */
static inline void turn(const REAL direction[3], REAL sign, REAL over, const REAL vector[4], REAL scale, REAL out[4]) {
    const REAL x = direction[0], y = direction[1], z = direction[2];
    const REAL level = x * vector[0] + y * vector[1], t = vector[2] + level * over;
    out[0] = scale * (vector[0] - sign * x * t);
    out[1] = scale * (sign * vector[1] - y * t);
    out[2] = scale * (level + z * vector[2]);
    out[3] = scale * vector[3];
}

/* Coordinates of a sigma point's image less those of the central one. */
static inline void off(REAL a, REAL b, REAL n, REAL w, REAL rho, REAL out[3]) {
    const REAL ahead = 1 + n, nearer = 1 / ahead;
    out[0] = a * nearer;
    out[1] = b * nearer;
    out[2] = (w + rho) / sqrt(a * a + b * b + ahead * ahead) - rho;
}

static void observe_set(const Matches *from, const Form *form, const Settings *by, const Observations *to, int64_t set) {
    const int64_t n = from->fields, all = from->sets * n, first = set * n;
    const Form own = *form;
    const REAL(*f)[3][3] = own.point, *dl = own.left, *dr = own.right;
    const REAL *restrict lu = from->left_px + first, *restrict lv = lu + all;
    const REAL *restrict ru = from->right_px + first, *restrict rv = ru + all;
    const REAL *restrict ls = from->left_sigma + first, *restrict rs = from->right_sigma + first;
    const REAL *restrict half = from->support_px + first;
    const uint8_t *restrict valid = from->valid + first;
    REAL *restrict m = to->moments + first, *restrict d = to->direction + first, *restrict covered = to->support + first;
    uint8_t *restrict good = to->valid + first;
    const REAL per_px = 1 / by->left.focal_px, cx = by->left.cx_px, cy = by->left.cy_px;
    const REAL spread = by->spread, each = by->each, rest = by->rest, share = by->share, tolerance = by->tolerance;
    const REAL left_step = spread * largest(dl[0], dl[1]), right_step = spread * largest(dr[0], dr[1]);
    const int rotated = by->rotated != 0;
#pragma GCC ivdep
    for (int64_t i = 0; i < n; i++) {
        const REAL u = lu[i], v = lv[i], p = ru[i], q = rv[i], left = ls[i], right = rs[i];
        REAL by_left[3][4], by_right[2][4], centre[4];
#pragma GCC unroll 4
        for (int h = 0; h < 4; h++) {
#pragma GCC unroll 3
            for (int k = 0; k < 3; k++) by_left[k][h] = f[h][k][0] * p + f[h][k][1] * q + f[h][k][2];
#pragma GCC unroll 2
            for (int k = 0; k < 2; k++) by_right[k][h] = f[h][0][k] * u + f[h][1][k] * v + f[h][2][k];
            centre[h] = by_left[0][h] * u + by_left[1][h] * v + by_left[2][h];
        }
        const REAL scale = 1 / sqrt(left * left + right * right), both = left * right * scale;
        const REAL alpha[2] = {rotated ? left * left * scale : left, rotated ? both : 0};
        const REAL beta[2] = {rotated ? -(right * right) * scale : 0, rotated ? both : right};
        const REAL inverse = 1 / sqrt(centre[0] * centre[0] + centre[1] * centre[1] + centre[2] * centre[2]);
        const REAL direction[3] = {centre[0] * inverse, centre[1] * inverse, centre[2] * inverse}, rho = centre[3] * inverse;
        const REAL sign = copysign((REAL)1, direction[2]), over = 1 / (sign + direction[2]), step = spread * inverse;
        REAL total[3] = {0, 0, 0}, second[6] = {0, 0, 0, 0, 0, 0};
#pragma GCC unroll 2
        for (int axis = 0; axis < 2; axis++) {
            REAL by_one[4], by_other[4], by_both[4];
            const REAL corner[4] = {f[0][axis][axis], f[1][axis][axis], f[2][axis][axis], f[3][axis][axis]};
            turn(direction, sign, over, by_left[axis], step, by_one);
            turn(direction, sign, over, by_right[axis], step, by_other);
            turn(direction, sign, over, corner, spread * step, by_both);
#pragma GCC unroll 2
            for (int column = 0; column < 2; column++) {
                const REAL a = alpha[column], b = beta[column];
                REAL even[4], odd[4], ahead[3], behind[3], e[3], o[3];
#pragma GCC unroll 4
                for (int h = 0; h < 4; h++) even[h] = a * b * by_both[h], odd[h] = a * by_one[h] + b * by_other[h];
                off(even[0] + odd[0], even[1] + odd[1], even[2] + odd[2], even[3] + odd[3], rho, ahead);
                off(even[0] - odd[0], even[1] - odd[1], even[2] - odd[2], even[3] - odd[3], rho, behind);
#pragma GCC unroll 3
                for (int k = 0; k < 3; k++) e[k] = ahead[k] + behind[k], o[k] = ahead[k] - behind[k], total[k] += e[k];
                second[0] += o[0] * o[0] + share * (e[0] * e[0]);
                second[1] += o[0] * o[1] + share * (e[0] * e[1]);
                second[2] += o[0] * o[2] + share * (e[0] * e[2]);
                second[3] += o[1] * o[1] + share * (e[1] * e[1]);
                second[4] += o[1] * o[2] + share * (e[1] * e[2]);
                second[5] += o[2] * o[2] + share * (e[2] * e[2]);
            }
        }
        const REAL shift[3] = {each * total[0], each * total[1], each * total[2]}, part = each / 2;
        const REAL xx = second[0] * part + rest * shift[0] * shift[0], xy = second[1] * part + rest * shift[0] * shift[1];
        const REAL xz = second[2] * part + rest * shift[0] * shift[2], yy = second[3] * part + rest * shift[1] * shift[1];
        const REAL yz = second[4] * part + rest * shift[1] * shift[2], zz = second[5] * part + rest * shift[2] * shift[2];
        /* `torchfovea.gaussian.definiteness`; no comparison passes NaN */
        const REAL sx = 1 / sqrt(xx), sy = 1 / sqrt(yy), sz = 1 / sqrt(zz), cxy = xy * sx * sy, cxz = xz * sx * sz;
        const REAL minor = 1 - cxy * cxy, other = 1 - cxz * cxz, across = yz * sy * sz - cxy * cxz;
        const REAL near_left = dl[0] * u + dl[1] * v + dl[2] - left_step * largest(alpha[0], alpha[1]);
        const REAL near_right = dr[0] * p + dr[1] * q + dr[2] - right_step * largest(beta[0], beta[1]);
        const int keep = (valid[i] != 0) & (left > 0) & (right > 0) & (near_left > 0) & (near_right > 0) &
                         (minor > tolerance) & (minor * other - across * across > tolerance) &
                         (xx + yy + zz < (REAL)INFINITY);
        const REAL ahead_x = (u - cx) * per_px, ahead_y = (v - cy) * per_px;
        covered[i] = half[i] * per_px / sqrt(1 + ahead_x * ahead_x + ahead_y * ahead_y);
        good[i] = keep;
        d[i] = direction[0], d[all + i] = direction[1], d[2 * all + i] = direction[2];
        m[i] = keep ? shift[0] : 1, m[all + i] = keep ? shift[1] : 1, m[2 * all + i] = keep ? rho + shift[2] : 1;
        m[3 * all + i] = keep ? xx : 1, m[4 * all + i] = keep ? xy : 0, m[5 * all + i] = keep ? xz : 0;
        m[6 * all + i] = keep ? yy : 1, m[7 * all + i] = keep ? yz : 0, m[8 * all + i] = keep ? zz : 1;
    }
}

/* Mean and covariance by components, directions, half the angles that are covered, and what is valid; elsewhere a unit
Gaussian. How many pairs of eyes are at one place. */
int64_t observe(const Matches *from, const Settings *by, const Observations *to) {
    int64_t together = 0;
    for (int64_t set = 0; set < from->sets; set++) {
        Form form;
        together += !form_of(from, by, set, &form);
        observe_set(from, &form, by, to, set);
    }
    return together;
}
