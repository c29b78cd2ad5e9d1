// The floor that the servo's speed is measured against: the arithmetic of the law once more, as C++ would do it.
//
// Structure of arrays, obstacle-outer and point-inner loops, no allocation, no checks; spheres only. Beside it a bare
// wake-up loop. Compiled and loaded by tools/bench.py, which also compares what it computes with what the law does.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <ctime>

namespace {

// Order of the pointers and scalars that bench.py passes.
enum { Q, QD, Q_EVAL, A, A_INV, H, G, J, JDQD, LAMBDA, JBAR, NT, P, JP, B, RADIUS, XD, OMEGA, E, E_ROT, V_REF, W_REF,
       Q_REST, Q_MIN, Q_MAX, QD_MAX, TAU_MAX, BRAKING, QDD_POSTURE, L_RHO0, L_MIN, L_NUM, L_ETA, L_KD, CENTRE, SPEED,
       BALL };
enum { KP, KV, V_MAX, A_MAX, W_MAX, ALPHA_MAX, MARGIN, KQ, DQ, RHO0, RHO_MIN, RHO_NUM, ETA, KD, LOOK, SOFT, M_MAX, DT,
       BAND, HORIZON, SHARE, EPSILON, SLOWEST };

constexpr int N = 16, M = 128, K = 128;  // room
double X[3][M], V[3][M], BB[6][M], F[3][M], rho[K][M], nx[K][M], ny[K][M], nz[K][M], acc[K][M], push[K][M];
double share[K][N + 1], least[K], force[K][3];

int64_t now() {
    timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

void towards(const double *ref, const double *e, double speed, double step, double *out) {
    double d[3], s = 0;
    for (int i = 0; i < 3; i++) d[i] = e[i] * speed - ref[i], s += d[i] * d[i];
    s = std::sqrt(s);
    double f = s <= step ? 1.0 : step / s;
    for (int i = 0; i < 3; i++) out[i] = ref[i] + d[i] * f;
}

double wanted(const double *e, double k, double v_max, double a_max) {  // speed over distance
    double d = std::sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]);
    if (d < 1e-12) return 0.0;
    double knee = a_max / (k * k), v = d <= knee ? k * d : std::sqrt(2 * a_max * (d - 0.5 * knee));
    return std::min(v, v_max) / d;
}

void mv(const double *m, const double *v, int r, int c, double *out) {
    for (int i = 0; i < r; i++) {
        double s = 0;
        for (int j = 0; j < c; j++) s += m[i * c + j] * v[j];
        out[i] = s;
    }
}

void tmv(const double *m, const double *v, int r, int c, double *out) {
    for (int j = 0; j < c; j++) out[j] = 0;
    for (int i = 0; i < r; i++)
        for (int j = 0; j < c; j++) out[j] += m[i * c + j] * v[i];
}

inline void firas(double r0, double rdot, double rho0, double rho_min, double rho_num, double eta, double kd, double &a,
                  double &d) {
    double r = r0 <= rho_num ? rho_num : r0, q = 1 / r - 1 / rho0;
    q = q <= 0 ? 0 : q;
    a = eta * q / (r * r);
    double rise = q / (1 / rho_min - 1 / rho0);
    rise = rise >= 1 ? 1 : rise;
    d = rdot >= 0 ? 0 : -kd * rise * rise * rdot;
    double cap = eta * (1 / rho_num - 1 / rho0) / (rho_num * rho_num);
    d = d >= cap ? cap : d;
}

void bounded(double *tau, const double *load, const double *tau_max, double least_share, int n) {
    double scale = 1;
    for (int i = 0; i < n; i++) {
        double room = std::max(tau_max[i] - std::fabs(load[i]), least_share * tau_max[i]);
        if (std::fabs(tau[i]) * scale > room) scale = room / std::fabs(tau[i]);
    }
    for (int i = 0; i < n; i++) tau[i] *= scale;
}

void field(const double *const *a, const double *s, const int64_t *link, int n, int m, int slots, double *tau) {
    const double *Jp = a[JP], *c = a[CENTRE], *w = a[SPEED], *ball = a[BALL], *radius = a[RADIUS];
    const double rho0 = s[RHO0], rho_num = s[RHO_NUM], floor_ = 1 / s[M_MAX], soft = s[SOFT];
    double dq[N], fastest = 0;
    for (int i = 0; i < n; i++) dq[i] = a[Q][i] - a[Q_EVAL][i], tau[i] = 0;
    for (int j = 0; j < m; j++)
        for (int i = 0; i < 3; i++) {
            double x = a[P][3 * j + i], v = 0;
            for (int k = 0; k < n; k++) x += Jp[(3 * j + i) * n + k] * dq[k], v += Jp[(3 * j + i) * n + k] * a[QD][k];
            X[i][j] = x, V[i][j] = v, F[i][j] = 0, BB[i][j] = a[B][9 * j + 4 * i];
        }
    for (int j = 0; j < m; j++) BB[3][j] = a[B][9 * j + 1], BB[4][j] = a[B][9 * j + 2], BB[5][j] = a[B][9 * j + 5];
    for (int k = 0; k < slots; k++) {
        double x = w[3 * k], y = w[3 * k + 1], z = w[3 * k + 2];
        fastest = std::max(fastest, std::sqrt(x * x + y * y + z * z));
    }
    for (int k = 0; k < slots; k++) {
        const double cx = c[3 * k], cy = c[3 * k + 1], cz = c[3 * k + 2], r = ball[k];
        for (int j = 0; j < m; j++) {
            double x = X[0][j] - cx, y = X[1][j] - cy, z = X[2][j] - cz;
            double d = std::sqrt(x * x + y * y + z * z), i = 1 / d;
            nx[k][j] = x * i, ny[k][j] = y * i, nz[k][j] = z * i, rho[k][j] = d - r - radius[j];
        }
        double low = rho[k][0];
        for (int j = 1; j < m; j++) low = rho[k][j] < low ? rho[k][j] : low;
        least[k] = low;
        force[k][0] = force[k][1] = force[k][2] = 0;
        if (low >= rho0 + s[LOOK] * fastest) continue;
        const double vx = w[3 * k], vy = w[3 * k + 1], vz = w[3 * k + 2];
        for (int j = 0; j < m; j++) {
            double x = nx[k][j], y = ny[k][j], z = nz[k][j], t = x * vx + y * vy + z * vz, f, d;
            double rdot = x * V[0][j] + y * V[1][j] + z * V[2][j] - t;
            double wide = t <= 0 ? 0 : t < soft ? 0.5 * t * t / soft : t - 0.5 * soft;
            firas(rho[k][j], rdot, rho0 + s[LOOK] * wide, s[RHO_MIN], rho_num, s[ETA], s[KD], f, d);
            double b = x * x * BB[0][j] + y * y * BB[1][j] + z * z * BB[2][j] +
                       2 * (x * y * BB[3][j] + x * z * BB[4][j] + y * z * BB[5][j]);
            acc[k][j] = f, push[k][j] = (f + d) / (b <= floor_ ? floor_ : b);
        }
        for (int l = 0; l <= n; l++) share[k][l] = 0;
        for (int j = 0; j < m; j++) share[k][link[j]] += acc[k][j];
        for (int j = 0; j < m; j++) {
            if (push[k][j] == 0) continue;
            double f = push[k][j] * acc[k][j] / share[k][link[j]], x = f * nx[k][j], y = f * ny[k][j], z = f * nz[k][j];
            F[0][j] += x, F[1][j] += y, F[2][j] += z, force[k][0] += x, force[k][1] += y, force[k][2] += z;
        }
    }
    for (int j = 0; j < m; j++) {
        const double *x = Jp + 3 * j * n, *y = x + n, *z = y + n;
        if (F[0][j] != 0 || F[1][j] != 0 || F[2][j] != 0)
            for (int k = 0; k < n; k++) tau[k] += x[k] * F[0][j] + y[k] * F[1][j] + z[k] * F[2][j];
    }
}

void law(const double *const *a, const double *s, const int64_t *link, int n, int m, int slots, double *out) {
    double v[3], w[3], drive[6], brake[6], t6[6], spring[N], damper[N], tn[N], load[N];
    double tau_drive[N], tau_brake[N], tau_rest[N], tau_damp[N], tau_field[N], tau_guard[N];
    double limits[N], sum[N], delta[N], k = s[KP] / s[KV];
    double sv = wanted(a[E], k, s[V_MAX], s[A_MAX]), sw = wanted(a[E_ROT], k, s[W_MAX], s[ALPHA_MAX]);
    double scale = 1;
    for (int i = 0; i < n; i++) {
        double qd = 0, tip = 0;  // asked of the joint; what the tip's motion needs of it
        for (int j = 0; j < 3; j++) {
            const double *row = a[JBAR] + 6 * i;
            qd += row[j] * a[E][j] * sv + row[3 + j] * a[E_ROT][j] * sw;
            tip += row[j] * a[XD][j] + row[3 + j] * a[OMEGA][j];
        }
        double rest = a[QD][i] - tip;
        double top = std::max(s[MARGIN] * a[QD_MAX][i] - (qd > 0 ? rest : -rest), s[SLOWEST] * a[QD_MAX][i]);
        if (std::fabs(qd) * scale > top) scale = top / std::fabs(qd);
    }
    towards(a[V_REF], a[E], sv * scale, s[A_MAX] * s[DT], v);
    towards(a[W_REF], a[E_ROT], sw * scale, s[ALPHA_MAX] * s[DT], w);
    for (int i = 0; i < 3; i++) {
        drive[i] = s[KV] * v[i], drive[3 + i] = s[KV] * w[i];
        brake[i] = -s[KV] * a[XD][i], brake[3 + i] = -s[KV] * a[OMEGA][i];
    }
    for (int i = 0; i < 6; i++) out[i] = drive[i] + brake[i], brake[i] -= a[JDQD][i];
    for (int i = 0; i < n; i++) {
        double top = a[QDD_POSTURE][i];
        spring[i] = std::min(std::max(s[KQ] * (a[Q_REST][i] - a[Q][i]), -top), top), damper[i] = -s[DQ] * a[QD][i];
        load[i] = a[G][i] + a[H][i];
    }
    mv(a[LAMBDA], drive, 6, 6, t6), tmv(a[J], t6, 6, n, tau_drive);
    mv(a[LAMBDA], brake, 6, 6, t6), tmv(a[J], t6, 6, n, tau_brake);
    mv(a[A], spring, n, n, tn), mv(a[NT], tn, n, n, tau_rest);
    mv(a[A], damper, n, n, tn), mv(a[NT], tn, n, n, tau_damp);
    field(a, s, link, n, m, slots, tau_field);
    for (int i = 0; i < n; i++) out[6 + i] = tau_field[i];
    for (int i = 0; i < n; i++) {
        double x, d, y, e;
        firas(a[Q][i] - a[Q_MIN][i], a[QD][i], a[L_RHO0][i], a[L_MIN][i], a[L_NUM][i], a[L_ETA][i], a[L_KD][i], x, d);
        firas(a[Q_MAX][i] - a[Q][i], -a[QD][i], a[L_RHO0][i], a[L_MIN][i], a[L_NUM][i], a[L_ETA][i], a[L_KD][i], y, e);
        limits[i] = a[A][i * n + i] * ((x + d) - (y + e));
    }
    bounded(tau_field, load, a[TAU_MAX], s[SHARE], n), bounded(limits, load, a[TAU_MAX], s[SHARE], n);
    for (int i = 0; i < n; i++)
        sum[i] = tau_drive[i] + tau_rest[i] + tau_brake[i] + tau_damp[i] + tau_field[i] + limits[i];
    double speed = std::sqrt(a[XD][0] * a[XD][0] + a[XD][1] * a[XD][1] + a[XD][2] * a[XD][2]);
    if (speed >= 0.5 * s[V_MAX]) {  // the tip's speed guard
        double row[N], accel = 0, mobility = 0;
        tmv(a[J], a[XD], 3, n, row);
        for (int i = 0; i < 3; i++) accel += a[JDQD][i] * a[XD][i] / speed;
        for (int i = 0; i < n; i++) row[i] /= speed;
        mv(a[A_INV], sum, n, n, tn);
        for (int i = 0; i < n; i++) accel += row[i] * tn[i];
        mv(a[A_INV], row, n, n, tn);
        for (int i = 0; i < n; i++) mobility += row[i] * tn[i];
        double excess = accel - (s[V_MAX] - speed) / s[HORIZON];
        for (int i = 0; i < n; i++) tn[i] = excess <= 0 ? 0 : -excess / std::max(mobility, s[EPSILON]) * row[i];
        bounded(tn, load, a[TAU_MAX], s[SHARE], n);
        for (int i = 0; i < n; i++) sum[i] += tn[i];
    }
    mv(a[A_INV], sum, n, n, tn);
    for (int i = 0; i < n; i++) {
        double top = s[BAND] * a[QD_MAX][i], twice = 2 * a[BRAKING][i];
        double up = std::min(top, std::sqrt(twice * std::max(0.0, a[Q_MAX][i] - a[Q][i])));
        double down = std::min(top, std::sqrt(twice * std::max(0.0, a[Q][i] - a[Q_MIN][i])));
        double high = (up - a[QD][i]) / s[HORIZON], low = (-down - a[QD][i]) / s[HORIZON];
        delta[i] = tn[i] > high ? high - tn[i] : tn[i] < low ? low - tn[i] : 0;
    }
    mv(a[A], delta, n, n, tau_guard);
    double share = 1;
    for (int i = 0; i < n; i++) {
        double ahead = tau_guard[i] > 0 ? sum[i] + load[i] : -sum[i] - load[i], top = a[TAU_MAX][i];
        double room = std::max(top - ahead, s[SHARE] * top);
        if (std::fabs(tau_guard[i]) * share > room) share = room / std::fabs(tau_guard[i]);
    }
    for (int i = 0; i < n; i++) out[6 + n + i] = sum[i] + load[i] + share * tau_guard[i];
}

}  // namespace

extern "C" {

// Run the law `count` times; `ns` gets the time of each. out: F* (6), torque of the field (n), whole torque (n).
void floor_law(const double *const *arrays, const double *scalars, const int64_t *link, int n, int m, int slots,
               int count, int64_t *ns, double *out) {
    for (int i = 0; i < count; i++) {
        int64_t begin = now();
        law(arrays, scalars, link, n, m, slots, out);
        ns[i] = now() - begin;
    }
}

// Wake up `count` times on an absolute grid of `period` [ns]; `late` gets how late each time.
void floor_wake(int64_t period, int count, int64_t *late) {
    int64_t when = now() + period;
    for (int i = 0; i < count; i++, when += period) {
        timespec at = {time_t(when / 1000000000), long(when % 1000000000)};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, nullptr) != 0) {
        }
        late[i] = now() - when;
        while (when + period < now()) when += period;
    }
}
}
