// The floor that the servo's speed is measured against: the arithmetic of the law once more, as C++ would do it.
//
// Structure of arrays, obstacle-outer and point-inner loops, no allocation, no checks; spheres only. The guards are found
// by the same algorithm: rows only for what is passed, Newton on the penalised program, the last answer as its start.
// Beside it a bare wake-up loop. Compiled and loaded by tools/bench.py, which also compares what it computes with what the law does.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <ctime>

namespace {

// Order of the pointers and scalars that bench.py passes.
enum { Q, QD, Q_EVAL, A, A_INV, H, G, J, JDQD, LAMBDA, JBAR, NT, P, JP, B, RADIUS, XD, OMEGA, E, E_ROT, V_REF, W_REF,
       Q_REST, QDD, Q_MIN, Q_MAX, QD_MAX, TAU_MAX, TAU_RATE, BRAKING, QDD_POSTURE, L_RHO0, L_MIN, L_NUM, L_ETA, L_KD, CENTRE,
       SPEED, BALL };
enum { KP, KV, V_MAX, A_MAX, W_MAX, ALPHA_MAX, MARGIN, KQ, DQ, RHO0, RHO_MIN, RHO_NUM, ETA, KD, LOOK, SOFT, M_MAX, DT,
       BAND, HORIZON, SHARE, SLOWEST, JERK, TIP_SLOW, ALIGNED, ZONE, BAND_LINK, STEPS, ROWS,
       YIELD, TURNED };

constexpr int N = 16, M = 128, K = 256;  // room
double X[3][M], V[3][M], BB[6][M], F[3][M], rho[K][M], nx[K][M], ny[K][M], nz[K][M], acc[K][M], push[K][M];
double share[K][N + 1], least[K], force[K][3];
bool close[K];
int near_list[K][M], near_count[K];
constexpr int R = 512, CANDIDATES = 2048;
struct Candidate { int k, j, state; double most; } cand[CANDIDATES];  // state: 0 cheap bound, 1 exact, 2 row made
double accel[3][M], steep[M];                                         // of the candidates' points
double rows[R][N], bound[R], stiff[R], over[2][R], high[N], low[N], tip_row[2][N], tip_most[2];
bool made[2 * N + 2];
int row_count, cand_count;

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

double mobility(const double *A_inv, const double *row, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s += row[i] * dot(A_inv + i * n, row, n);
    return s;
}

void add_row(double most, double along, double x[2][N], int n, const double *s) {
    int r = row_count++;
    bound[r] = most, stiff[r] = 1 / (s[YIELD] * std::max(along, 1e-12));
    for (int side = 0; side < 2; side++) over[side][r] = dot(rows[r], x[side], n) - most;
}

void accelerate(const double *const *a, const double *x, int n, int m) {
    for (int j = 0; j < m; j++)
        if (steep[j] >= 0)
            for (int i = 0; i < 3; i++) accel[i][j] = dot(a[JP] + (3 * j + i) * n, x, n);
}

double closing(const Candidate &c) {
    return -(nx[c.k][c.j] * accel[0][c.j] + ny[c.k][c.j] * accel[1][c.j] + nz[c.k][c.j] * accel[2][c.j]);
}

// Adds the rows that x[side] passes and that are not at hand.
void collect(const double *const *a, const double *s, int n, int m, double x[2][N], int side) {
    for (int i = 0; i < 2 * n; i++) {
        double past = i < n ? x[side][i] - high[i] : low[i - n] - x[side][i - n];
        if (past > 0 && !made[i] && row_count < R) {
            for (int k = 0; k < n; k++) rows[row_count][k] = 0;
            rows[row_count][i % n] = i < n ? 1 : -1;
            add_row(i < n ? high[i] : -low[i - n], a[A_INV][(i % n) * (n + 1)], x, n, s), made[i] = true;
        }
    }
    for (int t = 0; t < 2; t++) {
        const double *row = tip_row[t], most = tip_most[t];
        if (!(most < INFINITY) || made[2 * n + t] || row_count == R || !(dot(row, x[side], n) > most)) continue;
        for (int k = 0; k < n; k++) rows[row_count][k] = row[k];
        add_row(most, mobility(a[A_INV], row, n), x, n, s), made[2 * n + t] = true;
    }
    if (cand_count) accelerate(a, x[side], n, m);
    for (int i = 0; i < cand_count; i++) {
        Candidate &c = cand[i];
        if (c.state == 2 || !(closing(c) > c.most) || row_count == R) continue;
        double *row = rows[row_count];
        const double *px = a[JP] + 3 * c.j * n, *py = px + n, *pz = py + n;
        for (int k = 0; k < n; k++) row[k] = -nx[c.k][c.j] * px[k] - ny[c.k][c.j] * py[k] - nz[c.k][c.j] * pz[k];
        double along = mobility(a[A_INV], row, n);
        if (c.state == 0) {
            double jerk = jerk_along(row, along, a[TAU_RATE], n, s);
            c.most = may_towards(rho[c.k][c.j], dot(row, a[QD], n), INFINITY, s[A_MAX], jerk, s), c.state = 1;
        }
        if (closing(c) > c.most) add_row(c.most, along, x, n, s), c.state = 2;
    }
}

bool passed(const double *const *a, const double *x, int n, int m) {
    for (int i = 0; i < n; i++)
        if (x[i] > high[i] || x[i] < low[i]) return true;
    for (int t = 0; t < 2; t++)
        if (tip_most[t] < INFINITY && dot(tip_row[t], x, n) > tip_most[t]) return true;
    if (cand_count) accelerate(a, x, n, m);
    for (int i = 0; i < cand_count; i++)
        if (closing(cand[i]) > cand[i].most) return true;
    return false;
}

void newton_step(const double *A_, const double *wanted, int n, const double *x, double *to) {
    double H[N][N];
    for (int i = 0; i < n; i++) {
        to[i] = 0;
        for (int j = 0; j <= i; j++) H[i][j] = A_[i * n + j];
    }
    for (int r = 0; r < row_count; r++) {
        if (!(over[0][r] > 0)) continue;
        double pull = stiff[r] * (bound[r] - dot(rows[r], wanted, n));
        for (int i = 0; i < n; i++) {
            to[i] += pull * rows[r][i];
            double k = stiff[r] * rows[r][i];
            for (int j = 0; j <= i; j++) H[i][j] += k * rows[r][j];
        }
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < i; j++) {
            for (int l = 0; l < j; l++) H[i][j] -= H[i][l] * H[j][l];
            H[i][j] *= H[j][j];
        }
        for (int l = 0; l < i; l++) H[i][i] -= H[i][l] * H[i][l], to[i] -= H[i][l] * to[l];
        H[i][i] = 1 / std::sqrt(H[i][i]);
        to[i] *= H[i][i];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int l = i + 1; l < n; l++) to[i] -= H[l][i] * to[l];
        to[i] *= H[i][i];
    }
    for (int i = 0; i < n; i++) to[i] += wanted[i];
}

double slope(double t, double linear, double quadratic, double &second) {
    double first = linear + t * quadratic;
    second = quadratic;
    for (int r = 0; r < row_count; r++) {
        double change = over[1][r] - over[0][r], past = over[0][r] + t * change;
        if (past > 0) first += stiff[r] * past * change, second += stiff[r] * change * change;
    }
    return first;
}

void take_step(const double *A_, const double *wanted, int n, const double *s, double x[2][N]) {
    double linear = 0, quadratic = 0, second;
    for (int i = 0; i < n; i++) {
        double p = 0, q = 0;
        for (int k = 0; k < n; k++) p += A_[i * n + k] * (x[0][k] - wanted[k]), q += A_[i * n + k] * (x[1][k] - x[0][k]);
        linear += (x[1][i] - x[0][i]) * p, quadratic += (x[1][i] - x[0][i]) * q;
    }
    double start = std::fabs(slope(0, linear, quadratic, second)), lo = 0, hi = 1, t = 1;
    double first = slope(1, linear, quadratic, second);
    if (first > s[TURNED] * start)
        for (int i = 0; i < int(s[STEPS]); i++) {
            (first > 0 ? hi : lo) = t;
            t -= first / second;
            if (!(lo < t && t < hi)) t = 0.5 * (lo + hi);
            first = slope(t, linear, quadratic, second);
            if (std::fabs(first) <= s[TURNED] * start) break;
        }
    for (int i = 0; i < n; i++) x[0][i] += t * (x[1][i] - x[0][i]);
    for (int r = 0; r < row_count; r++) over[0][r] = dot(rows[r], x[0], n) - bound[r];
}

// Moves x[0] to what is nearest to `wanted` in A's norm and keeps the bounds.
void nearest_kept(const double *const *a, const double *s, int n, int m, const double *wanted, double x[2][N]) {
    for (int r = 0; r < row_count; r++) over[0][r] = dot(rows[r], x[0], n) - bound[r];
    collect(a, s, n, m, x, 0);
    for (int step = 0; step < int(s[STEPS]); step++) {
        newton_step(a[A], wanted, n, x[0], x[1]);
        for (int r = 0; r < row_count; r++) over[1][r] = dot(rows[r], x[1], n) - bound[r];
        collect(a, s, n, m, x, 1);
        bool settled = true;
        for (int r = 0; r < row_count; r++) settled &= (over[0][r] > 0) == (over[1][r] > 0);
        if (settled) {
            for (int i = 0; i < n; i++) x[0][i] = x[1][i];
            break;
        }
        take_step(a[A], wanted, n, s, x);
    }
    for (int i = 0; i < n; i++) x[0][i] = std::min(std::max(x[0][i], low[i]), high[i]);
}

// Changes tau (all but the load) into what keeps the bounds and what the motors have room for.
void guarded(const double *const *a, const double *s, const double *load, int n, int m, double *tau) {
    double wanted[N], less[N], x[2][N] = {}, d[N];
    double f = fitting(tau, load, a[TAU_MAX], s[SHARE], n);
    mv(a[A_INV], tau, n, n, wanted);
    if (!passed(a, wanted, n, m)) {
        for (int i = 0; i < n; i++) less[i] = f * tau[i];
        if (f < 1) mv(a[A_INV], less, n, n, d);
        if (f == 1 || !passed(a, d, n, m)) {
            f = fitting(less, load, a[TAU_MAX], s[SHARE], n);
            for (int i = 0; i < n; i++) tau[i] = f * less[i];
            return;
        }
    }
    row_count = 0;
    for (int i = 0; i < 2 * n + 2; i++) made[i] = false;
    for (int i = 0; i < n; i++) x[0][i] = a[QDD][i];
    for (int attempt = 0; attempt < 2; attempt++) {
        nearest_kept(a, s, n, m, wanted, x);
        for (int i = 0; i < n; i++) d[i] = x[0][i] - wanted[i];
        mv(a[A], d, n, n, less);
        for (int i = 0; i < n; i++) less[i] += tau[i];
        f = fitting(less, load, a[TAU_MAX], s[SHARE], n);
        if (attempt == 1 || f == 1) break;
        for (int i = 0; i < n; i++) tau[i] *= f;
        mv(a[A_INV], tau, n, n, wanted);
    }
    for (int i = 0; i < n; i++) tau[i] = f * less[i];
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
        const double cutoff = rho0 + s[LOOK] * fastest;
        close[k] = low < cutoff;
        if (!close[k]) continue;
        int count = 0;
        for (int j = 0; j < m; j++) near_list[k][count] = j, count += rho[k][j] < cutoff;
        near_count[k] = count;
        const double vx = w[3 * k], vy = w[3 * k + 1], vz = w[3 * k + 2];
        for (int l = 0; l <= n; l++) share[k][l] = 0;
        for (int c = 0; c < count; c++) {
            const int j = near_list[k][c];
            double x = nx[k][j], y = ny[k][j], z = nz[k][j], t = x * vx + y * vy + z * vz, f, d;
            double rdot = x * V[0][j] + y * V[1][j] + z * V[2][j] - t;
            double wide = t <= 0 ? 0 : t < soft ? 0.5 * t * t / soft : t - 0.5 * soft;
            double reach = rho0 + s[LOOK] * wide;
            acc[k][j] = push[k][j] = 0;
            if (rho[k][j] >= reach) continue;
            firas(rho[k][j], rdot, reach, s[RHO_MIN], rho_num, s[ETA], s[KD], f, d);
            double b = x * x * BB[0][j] + y * y * BB[1][j] + z * z * BB[2][j] +
                       2 * (x * y * BB[3][j] + x * z * BB[4][j] + y * z * BB[5][j]);
            acc[k][j] = f, push[k][j] = (f + d) * (b <= floor_ ? b * s[M_MAX] * s[M_MAX] : 1 / b);
            share[k][link[j]] += f;
        }
        for (int c = 0; c < count; c++) {
            const int j = near_list[k][c];
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

// Writes tip_row[t] along v (3,) and returns the jerk along it.
double tip_along(const double *const *a, const double *s, const double *v, int t, int n) {
    double size = std::sqrt(dot(v, v, 3));
    tmv(a[J], v, 3, n, tip_row[t]);
    for (int i = 0; i < n; i++) tip_row[t][i] /= size;
    return jerk_along(tip_row[t], mobility(a[A_INV], tip_row[t], n), a[TAU_RATE], n, s);
}

// The bounds of the guards: joints, the tip, and cheap ones of the points that approach an obstacle.
void gather(const double *const *a, const double *s, const int64_t *link, int n, int m, int slots) {
    for (int i = 0; i < n; i++) {
        double jerk = INFINITY;
        for (int k = 0; k < n; k++) {
            double x = std::fabs(a[A][k * n + i]);
            if (x * jerk > s[JERK] * a[TAU_RATE][k]) jerk = s[JERK] * a[TAU_RATE][k] / x;
        }
        double top = s[BAND] * a[QD_MAX][i], q = a[Q][i], qd = a[QD][i], brake = a[BRAKING][i];
        high[i] = may_towards(a[Q_MAX][i] - q, qd, top, brake, jerk, s);
        low[i] = -may_towards(q - a[Q_MIN][i], -qd, top, brake, jerk, s);
        if (low[i] > 0) high[i] = std::max(high[i], low[i]);
        else if (high[i] < 0) low[i] = std::min(low[i], high[i]);
    }
    double v[3], speed = std::sqrt(dot(a[XD], a[XD], 3)), accel = 0, along = 0, peak = 0, slews = 0;
    bool slow = speed < s[TIP_SLOW] * s[V_MAX];
    for (int i = 0; i < n; i++) slews = std::max(slews, std::fabs(dot(a[A] + i * n, a[QDD], n)) / a[TAU_RATE][i]);
    tip_most[0] = tip_most[1] = INFINITY;
    for (int c = 0; c < 3; c++) v[c] = a[JDQD][c] + dot(a[J] + c * n, a[QDD], n), accel += v[c] * v[c];
    if (accel > 0) {
        double back = 0.5 * std::max(std::sqrt(accel) / std::max(tip_along(a, s, v, 1, n), 1e-9), slews);
        for (int c = 0; c < 3; c++) v[c] = a[XD][c] + back * v[c], peak += v[c] * v[c], along += v[c] * a[XD][c];
        peak = std::sqrt(peak);
        if (peak >= s[TIP_SLOW] * s[V_MAX] && (slow || along < s[ALIGNED] * peak * speed)) {
            double jerk = tip_along(a, s, v, 1, n), gap = s[V_MAX] - along / peak;
            tip_most[1] = may(s[V_MAX], along / peak, jerk, s);
            if (gap > 0 && slews > 0) tip_most[1] = std::min(tip_most[1], 2 * gap / slews);
            tip_most[1] -= dot(a[JDQD], v, 3) / peak;
        }
    }
    if (!slow) {
        double jerk = tip_along(a, s, a[XD], 0, n);
        tip_most[0] = may(s[V_MAX], speed, jerk, s) - dot(a[JDQD], a[XD], 3) / speed;
    }
    const double zone = s[ZONE] * s[RHO0];
    double best[N + 1];
    cand_count = 0;
    for (int k = 0; k < slots; k++) {
        if (!close[k] || !(least[k] < zone)) continue;
        int first = cand_count, end = first;
        for (int i = 0; i < near_count[k]; i++) {
            int j = near_list[k][i];
            if (rho[k][j] < zone && end < CANDIDATES) cand[end++].j = j, best[link[j]] = zone - s[BAND_LINK];
        }
        for (int c = first; c < end; c++) best[link[cand[c].j]] = std::min(best[link[cand[c].j]], rho[k][cand[c].j]);
        for (int c = first; c < end; c++) {
            int j = cand[c].j;
            if (rho[k][j] < best[link[j]] + s[BAND_LINK]) cand[cand_count++] = {k, j, 0, 0};
        }
    }
    if (!cand_count) return;
    for (int j = 0; j < m; j++) steep[j] = -1;
    for (int i = 0; i < cand_count; i++) {
        Candidate &c = cand[i];
        int j = c.j;
        if (steep[j] < 0) {
            double most = 0;
            for (int k = 0; k < n; k++) {
                const double *p = a[JP] + 3 * j * n + k;
                most = std::max(most, (p[0] * p[0] + p[n] * p[n] + p[2 * n] * p[2 * n]) / (a[TAU_RATE][k] * a[TAU_RATE][k]));
            }
            steep[j] = std::max(std::sqrt(most), 1e-9);
        }
        double x = nx[c.k][j], y = ny[c.k][j], z = nz[c.k][j];
        double b = x * x * BB[0][j] + y * y * BB[1][j] + z * z * BB[2][j] +
                   2 * (x * y * BB[3][j] + x * z * BB[4][j] + y * z * BB[5][j]);
        double jerk = (1 - 1e-9) * s[JERK] * std::max(b, 0.0) / steep[j];
        double v = -(x * V[0][j] + y * V[1][j] + z * V[2][j]);
        c.most = may_towards(rho[c.k][j], v, INFINITY, s[A_MAX], jerk, s);
        c.most -= 1e-9 * (1 + std::fabs(c.most));
    }
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
    gather(a, s, link, n, m, slots);
    guarded(a, s, load, n, m, sum);
    for (int i = 0; i < n; i++) out[6 + n + i] = sum[i] + load[i];
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
