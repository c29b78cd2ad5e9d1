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
       Q_REST, Q_MIN, Q_MAX, QD_MAX, TAU_MAX, TAU_RATE, BRAKING, QDD_POSTURE, L_RHO0, L_MIN, L_NUM, L_ETA, L_KD, CENTRE, SPEED,
       BALL };
enum { KP, KV, V_MAX, A_MAX, W_MAX, ALPHA_MAX, MARGIN, KQ, DQ, RHO0, RHO_MIN, RHO_NUM, ETA, KD, LOOK, SOFT, M_MAX, DT,
       BAND, HORIZON, SHARE, SLOWEST, JERK, TIP_SLOW, NEAR, ABREAST, ENOUGH, STEPS, PAIRS,
       YIELD };

constexpr int N = 16, M = 128, K = 128;  // room
double X[3][M], V[3][M], BB[6][M], F[3][M], rho[K][M], nx[K][M], ny[K][M], nz[K][M], acc[K][M], push[K][M];
double share[K][N + 1], least[K], force[K][3];
bool close[K];
constexpr int C = 2 * N + 129;  // bounds of the guards
double bound_rows[C][N], bounds[C], towards_row[C][N], size[C];

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

double fitting(const double *tau, const double *load, const double *tau_max, double least_share, int n) {
    double scale = 1;
    for (int i = 0; i < n; i++) {
        double spare = tau[i] > 0 ? tau_max[i] - load[i] : tau_max[i] + load[i];
        double room = std::max(std::min(spare, tau_max[i]), least_share * tau_max[i]);
        if (std::fabs(tau[i]) * scale > room) scale = room / std::fabs(tau[i]);
    }
    return scale;
}

double dot(const double *a, const double *b, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s += a[i] * b[i];
    return s;
}

double may(double bound, double speed, double jerk, const double *s) {
    double gap = bound - speed, accel = gap / s[HORIZON];
    return gap > 0 ? std::min(accel, std::sqrt(2 * jerk * gap)) : accel;
}

double may_towards(double room, double speed, double top, double braking, double jerk, const double *s) {
    double curve = std::sqrt(2 * braking * std::max(0.0, room - 2 * s[HORIZON] * s[HORIZON] * braking));
    if (curve >= top) return may(top, speed, jerk, s);
    double slope = braking * std::min(1.0, std::max(0.0, speed) / std::max(curve, s[HORIZON] * braking));
    return may(curve, speed, jerk, s) - slope;
}

double jerk_along(const double *row, double mobility, const double *rate, int n, const double *s) {
    double slowest = 1e-9;
    for (int i = 0; i < n; i++) slowest = std::max(slowest, std::fabs(row[i]) / rate[i]);
    return s[JERK] * mobility / slowest;
}

void shares(const int *active, int k, int fresh, int n, double soft, double *r) {
    static double L[C][C];
    for (int i = 0; i < k; i++) {
        for (int j = 0; j <= i; j++) {
            double v = dot(bound_rows[active[i]], towards_row[active[j]], n);
            if (i == j) v += soft * size[active[i]] * size[active[i]];
            for (int l = 0; l < j; l++) v -= L[i][l] * L[j][l];
            L[i][j] = i == j ? std::sqrt(v) : v / L[j][j];
        }
        double v = dot(bound_rows[active[i]], towards_row[fresh], n);
        for (int l = 0; l < i; l++) v -= L[i][l] * r[l];
        r[i] = v / L[i][i];
    }
    for (int i = k - 1; i >= 0; i--) {
        double v = r[i];
        for (int l = i + 1; l < k; l++) v -= L[l][i] * r[l];
        r[i] = v / L[i][i];
    }
}

// The accelerations x, moved as little as may be (in A's norm) to keep the first `count` bounds.
void least_change(const double *A_inv, int count, int n, const double *s, double *x) {
    int active[C], k = 0, fresh = -1;
    bool held[C] = {};
    double mult[C], r[C], z[N], pull = 0;
    for (int c = 0; c < count; c++) {
        for (int i = 0; i < n; i++) towards_row[c][i] = dot(A_inv + i * n, bound_rows[c], n);
        size[c] = std::sqrt(std::max(dot(bound_rows[c], towards_row[c], n), 1e-12));
    }
    for (int turn = 0; turn < int(s[STEPS]); turn++) {
        if (fresh < 0) {
            double worst = s[ENOUGH];
            for (int c = 0; c < count; c++) {
                double over = held[c] ? 0 : (dot(bound_rows[c], x, n) - bounds[c]) / size[c];
                if (over > worst) worst = over, fresh = c, pull = 0;
            }
            if (fresh < 0) break;
        }
        shares(active, k, fresh, n, s[YIELD], r);
        for (int i = 0; i < n; i++) z[i] = towards_row[fresh][i];
        for (int a = 0; a < k; a++)
            for (int i = 0; i < n; i++) z[i] -= r[a] * towards_row[active[a]][i];
        double give = s[YIELD] * size[fresh] * size[fresh];
        double step = dot(bound_rows[fresh], x, n) - bounds[fresh] - give * pull;
        step /= dot(bound_rows[fresh], z, n) + give;
        int drop = -1;
        for (int a = 0; a < k; a++)
            if (mult[a] < step * r[a]) step = mult[a] / r[a], drop = a;
        for (int i = 0; i < n; i++) x[i] -= step * z[i];
        pull += step;
        for (int a = 0; a < k; a++) mult[a] -= step * r[a];
        if (drop < 0) {
            active[k] = fresh, mult[k] = pull, held[fresh] = true, k++, fresh = -1;
        } else {
            held[active[drop]] = false;
            for (int a = drop; a < k - 1; a++) active[a] = active[a + 1], mult[a] = mult[a + 1];
            k--;
        }
    }
}

// Adds to tau what keeps the first `count` bounds; those of the joints come first and hold in any case.
void guard(const double *A, const double *A_inv, int count, int n, const double *s, double *tau) {
    double wanted[N], x[N];
    bool acts = false;
    mv(A_inv, tau, n, n, wanted);
    for (int c = 0; c < count; c++) acts |= dot(bound_rows[c], wanted, n) > bounds[c];
    if (!acts) return;
    for (int i = 0; i < n; i++) x[i] = wanted[i];
    least_change(A_inv, count, n, s, x);
    for (int i = 0; i < n; i++) x[i] = std::min(std::max(x[i], -bounds[n + i]), bounds[i]) - wanted[i];
    mv(A, x, n, n, wanted);
    for (int i = 0; i < n; i++) tau[i] += wanted[i];
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
        close[k] = low < rho0 + s[LOOK] * fastest;
        if (!close[k]) continue;
        const double vx = w[3 * k], vy = w[3 * k + 1], vz = w[3 * k + 2];
        for (int j = 0; j < m; j++) {
            double x = nx[k][j], y = ny[k][j], z = nz[k][j], t = x * vx + y * vy + z * vz, f, d;
            double rdot = x * V[0][j] + y * V[1][j] + z * V[2][j] - t;
            double wide = t <= 0 ? 0 : t < soft ? 0.5 * t * t / soft : t - 0.5 * soft;
            firas(rho[k][j], rdot, rho0 + s[LOOK] * wide, s[RHO_MIN], rho_num, s[ETA], s[KD], f, d);
            double b = x * x * BB[0][j] + y * y * BB[1][j] + z * z * BB[2][j] +
                       2 * (x * y * BB[3][j] + x * z * BB[4][j] + y * z * BB[5][j]);
            acc[k][j] = f, push[k][j] = (f + d) * (b <= floor_ ? b * s[M_MAX] * s[M_MAX] : 1 / b);
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

// The bounds of the guards: joints upward, joints downward, the tip, what links approach. Returns how many.
int gather(const double *const *a, const double *s, const int64_t *link, int n, int m, int slots) {
    for (int i = 0; i < n; i++) {
        double jerk = INFINITY;
        for (int k = 0; k < n; k++) {
            double x = std::fabs(a[A][k * n + i]);
            if (x * jerk > s[JERK] * a[TAU_RATE][k]) jerk = s[JERK] * a[TAU_RATE][k] / x;
        }
        double top = s[BAND] * a[QD_MAX][i], q = a[Q][i], qd = a[QD][i], brake = a[BRAKING][i];
        double high = may_towards(a[Q_MAX][i] - q, qd, top, brake, jerk, s);
        double low = -may_towards(q - a[Q_MIN][i], -qd, top, brake, jerk, s);
        if (low > 0) high = std::max(high, low);
        else if (high < 0) low = std::min(low, high);
        for (int k = 0; k < n; k++) bound_rows[i][k] = i == k, bound_rows[n + i][k] = i == k ? -1 : 0;
        bounds[i] = high, bounds[n + i] = -low;
    }
    int count = 2 * n;
    double *row = bound_rows[count], tn[N], drift = 0;
    double speed = std::sqrt(dot(a[XD], a[XD], 3));
    if (speed < s[TIP_SLOW] * s[V_MAX]) {
        for (int i = 0; i < n; i++) row[i] = 0;
        bounds[count++] = INFINITY;
    } else {
        tmv(a[J], a[XD], 3, n, row);
        for (int i = 0; i < n; i++) row[i] /= speed;
        drift = dot(a[JDQD], a[XD], 3) / speed;
        mv(a[A_INV], row, n, n, tn);
        bounds[count++] = may(s[V_MAX], speed, jerk_along(row, dot(row, tn, n), a[TAU_RATE], n, s), s) - drift;
    }
    for (int k = 0, pairs = 0; k < slots; k++)
        for (int l = 0; close[k] && l <= n; l++) {
            double low = s[NEAR] * s[RHO0] - s[ABREAST];
            for (int j = 0; j < m; j++) low = link[j] == l && rho[k][j] < low ? rho[k][j] : low;
            for (int j = 0; j < m; j++) {
                if (link[j] != l || rho[k][j] >= low + s[ABREAST] || pairs == int(s[PAIRS])) continue;
                const double *x = a[JP] + 3 * j * n, *y = x + n, *z = y + n;
                row = bound_rows[count];
                for (int i = 0; i < n; i++) row[i] = -nx[k][j] * x[i] - ny[k][j] * y[i] - nz[k][j] * z[i];
                mv(a[A_INV], row, n, n, tn);
                double jerk = jerk_along(row, dot(row, tn, n), a[TAU_RATE], n, s);
                bounds[count++] = may_towards(rho[k][j], dot(row, a[QD], n), INFINITY, s[A_MAX], jerk, s);
                pairs++;
            }
        }
    return count;
}

void law(const double *const *a, const double *s, const int64_t *link, int n, int m, int slots, double *out) {
    double v[3], w[3], drive[6], brake[6], t6[6], spring[N], damper[N], tn[N], load[N];
    double tau_drive[N], tau_brake[N], tau_rest[N], tau_damp[N], tau_field[N];
    double limits[N], sum[N], k = s[KP] / s[KV];
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
    double f = fitting(tau_field, load, a[TAU_MAX], s[SHARE], n), g = fitting(limits, load, a[TAU_MAX], s[SHARE], n);
    double share_left = 1;  // of what drives, beside what is kept
    for (int i = 0; i < n; i++) {
        sum[i] = tau_brake[i] + tau_damp[i] + f * tau_field[i] + g * limits[i];
        tau_drive[i] += tau_rest[i];
        double kept = load[i] + sum[i], top = a[TAU_MAX][i], d = tau_drive[i];
        if (d != 0 && std::fabs(kept + share_left * d) > top)
            share_left = std::min(share_left, std::max(0.0, ((d > 0 ? top : -top) - kept) / d));
    }
    for (int i = 0; i < n; i++) sum[i] += share_left * tau_drive[i];
    int count = gather(a, s, link, n, m, slots);
    for (int i = 0; i < n; i++) tn[i] = sum[i];
    guard(a[A], a[A_INV], count, n, s, tn);
    f = fitting(tn, load, a[TAU_MAX], s[SHARE], n);
    if (f < 1) {
        for (int i = 0; i < n; i++) tn[i] = f * sum[i];
        guard(a[A], a[A_INV], count, n, s, tn);
    }
    f = fitting(tn, load, a[TAU_MAX], s[SHARE], n);
    for (int i = 0; i < n; i++) out[6 + n + i] = f * tn[i] + load[i];
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
