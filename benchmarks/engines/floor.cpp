// The bench as a specialist would write it for this scene alone: a plain loop of DOP853 over 16
// states, the equations of two vehicles, a linear buffer and two walls, and located events.  No
// energy ledger, no peak loads, no supports, no limit of a step by the path to an event: a touch
// that begins and ends within a step is not seen.
//
// Step control and dense output: Hairer, Norsett and Wanner 1993, II.5 and II.6.  The sums of the
// stages are in dop853_sums.h, which floor.py writes from SciPy's coefficients.

#include <algorithm>
#include <cmath>
#include <limits>

namespace {

constexpr int N = 16;  // q: x_S y_S theta_S theta_P h x_T y_T theta_T, then their rates
constexpr int ROWS = 16;
constexpr double JUST_OFF = 1e-13;  // m: gap at which a touch has ended, as for CVODE and SciPy

struct Parameters {  // as floor.py packs them, SI units
    double m_S, I_S, m_C, m_P, m_T, I_T, a, first_moment, hinge_inertia, d, k_A, c_A, k_T, c_T, h_0;
    double R_t, L_T, R_c, L_c, cos_b, sin_b, K, hysteresis, v_floor, mu, inverse_v_eps;
};

struct Wall {
    bool on = false;
    double chi = 0.0;
    long latest = -1;
};

struct Tip {
    double px, py, wx, wy;
};

struct Distance {
    double gap, rate, nx, ny;
};

// fdlibm's polynomials (Sun Microsystems 1993) up to an eighth turn: a call to the C library costs
// more than the rest of an evaluation
inline void sine_cosine(double x, double* s, double* c) {
    if (!(std::abs(x) < 0.785398163397448)) {
        *s = std::sin(x);
        *c = std::cos(x);
        return;
    }
    const double z = x * x, w = z * z;
    *s = x + x * z * ((-1.66666666666666324348e-01 + z * 8.33333333332248946124e-03) +
                      w * ((-1.98412698298579493134e-04 + z * 2.75573137070700676789e-06) +
                           w * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)));
    *c = 1.0 - 0.5 * z +
         w * ((4.16666666666666019037e-02 + z * -1.38888888888741095749e-03) +
              w * ((2.48015872894767294178e-05 + z * -2.75573143513906633035e-07) +
                   w * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)));
}

Tip tip_of(const Parameters& p, const double* y, double sS, double cS, double sP, double cP,
           double sT, double cT) {
    const double swing = p.a * y[10], spin = y[4] * y[11];
    const double rx = y[0] + p.a * cS + y[4] * cP - y[5], ry = y[1] + p.a * sS + y[4] * sP - y[6];
    const double ux = y[8] - swing * sS + y[12] * cP - spin * sP - y[13];
    const double uy = y[9] + swing * cS + y[12] * sP + spin * cP - y[14];
    const double px = cT * rx + sT * ry, py = cT * ry - sT * rx;
    return {px, py, cT * ux + sT * uy + y[15] * py, cT * uy - sT * ux - y[15] * px};
}

Tip tip_of(const Parameters& p, const double* y) {
    double sS, cS, sP, cP, sT, cT;
    sine_cosine(y[2], &sS, &cS);
    sine_cosine(y[3], &sP, &cP);
    sine_cosine(y[7], &sT, &cT);
    return tip_of(p, y, sS, cS, sP, cP, sT, cT);
}

Distance to_wall(const Parameters& p, const Tip& tip, double side) {
    const double u = -(tip.px + p.L_T), Y = side * tip.py;
    const double along = u * p.cos_b + (Y - p.R_c) * p.sin_b;
    double distance, n_u, n_Y;
    if (along > 0.0 && along < p.L_c) {
        const double across = u * p.sin_b - (Y - p.R_c) * p.cos_b, sign = across < 0.0 ? -1.0 : 1.0;
        distance = sign * across;
        n_u = sign * p.sin_b;
        n_Y = -sign * p.cos_b;
    } else {
        const double end = along <= 0.0 ? 0.0 : p.L_c;
        n_u = u - end * p.cos_b;
        n_Y = Y - p.R_c - end * p.sin_b;
        distance = std::sqrt(n_u * n_u + n_Y * n_Y);
        n_u /= distance;
        n_Y /= distance;
    }
    return {distance - p.R_t, -n_u * tip.wx + side * n_Y * tip.wy, -n_u, side * n_Y};
}

void rates(const Parameters& p, const Wall* walls, const double* y, double* f) {
    double sS, cS, sP, cP;
    sine_cosine(y[2], &sS, &cS);
    sine_cosine(y[3], &sP, &cP);
    const double sD = sP * cS - cP * sS, cD = cP * cS + sP * sS;
    const double h = y[4], omega = y[10], spin = y[11], rate = y[12];
    const double m_CP = p.m_C + p.m_P, m_SC = p.m_S + p.m_C, total = m_SC + p.m_P;
    const double r = h - p.d, moment = p.first_moment + p.m_P * h;
    const double inertia = p.hinge_inertia + p.m_P * r * r;
    double fx = 0.0, fy = 0.0, tip_torque = 0.0, target = 0.0, gx = 0.0, gy = 0.0;
    if (walls[0].on || walls[1].on) {
        double sT, cT;
        sine_cosine(y[7], &sT, &cT);
        const Tip tip = tip_of(p, y, sS, cS, sP, cP, sT, cT);
        for (int i = 0; i < 2; ++i) {
            if (!walls[i].on) continue;
            const Distance to = to_wall(p, tip, 1.0 - 2.0 * i);
            const double depth = std::max(-to.gap, 0.0), shape = depth * std::sqrt(depth);
            const double force = std::max(shape * (p.K - walls[i].chi * to.rate), 0.0);
            const double distance = to.gap + p.R_t;
            const double slip = tip.wy * to.nx - tip.wx * to.ny - distance * (spin - y[15]);
            const double share = std::tanh(slip * p.inverse_v_eps);
            const double friction = -force * p.mu * share;
            const double wx = force * to.nx - friction * to.ny, wy = force * to.ny + friction * to.nx;
            fx += wx;
            fy += wy;
            tip_torque -= distance * friction;
            target -= (tip.px - distance * to.nx) * wy - (tip.py - distance * to.ny) * wx;
        }
        gx = cT * fx - sT * fy;
        gy = sT * fx + cT * fy;
    }
    const double f_u = gx * cP + gy * sP, f_w = gy * cP - gx * sP;
    const double torque = -p.k_T * (y[3] - y[2]) - p.c_T * (spin - omega);
    const double w2 = p.a * omega * omega, s2 = spin * spin, coriolis = 2.0 * p.m_P * rate * spin;
    const double R_u = f_u + m_CP * w2 * cD + moment * s2;
    const double R_w = f_w - m_CP * w2 * sD - coriolis;
    const double R_S = p.a * (sD * R_u + cD * R_w) - torque;
    const double R_P = h * f_w + tip_torque + torque - moment * w2 * sD - coriolis * r;
    const double R_h = f_u - p.k_A * (h - p.h_0) - p.c_A * rate + p.m_P * (w2 * cD + r * s2);
    // theta_P and h are eliminated, then the chaser's translation
    const double ratio = moment / inertia, coupled = moment * ratio;
    const double b_u = R_u - R_h, b_w = R_w - ratio * R_P;
    const double b_S = R_S - p.a * (cD * ratio * R_P + sD * R_h);
    const double S_w = total - coupled, S_uS = p.m_C * p.a * sD, S_wS = p.a * cD * (m_CP - coupled);
    const double S_S = p.I_S + p.a * p.a * (m_CP - cD * cD * coupled - p.m_P * sD * sD);
    const double e_u = S_uS / m_SC, e_w = S_wS / S_w;
    const double alpha = (b_S - e_u * b_u - e_w * b_w) / (S_S - e_u * S_uS - e_w * S_wS);
    const double acc_u = b_u / m_SC - e_u * alpha, acc_w = b_w / S_w - e_w * alpha;
    for (int i = 0; i < 8; ++i) f[i] = y[8 + i];
    f[8] = acc_u * cP - acc_w * sP;
    f[9] = acc_u * sP + acc_w * cP;
    f[10] = alpha;
    f[11] = (R_P - moment * (acc_w + p.a * cD * alpha)) / inertia;
    f[12] = R_h / p.m_P - acc_u - p.a * sD * alpha;
    f[13] = -gx / p.m_T;
    f[14] = -gy / p.m_T;
    f[15] = target / p.I_T;
}

#include "dop853_sums.h"  // stage_sum, error_sums, dense_rows and C

void interpolate(const double* y, const double F[7][N], double x, double* inside) {
    for (int i = 0; i < N; ++i) {
        double value = 0.0;
        for (int k = 6; k >= 0; --k) value = (value + F[k][i]) * (k % 2 == 0 ? x : 1.0 - x);
        inside[i] = y[i] + value;
    }
}

}  // namespace

// Integrates from 0 to t_end (s); returns the number of touches, -1 if the step falls below 1e-15 s,
// -2 if there are more than room touches.  y (16) is changed; weights (16) are 1 / permitted error;
// touches receives rows of start, end and wall.
extern "C" long solve(const Parameters* par, double* y, const double* weights, double t_end,
                      double* touches, long room, long* evaluations) {
    const Parameters& p = *par;
    Wall walls[2];
    alignas(32) double K[ROWS][N], F[7][N], y_stage[N], y_new[N], inside[N];
    double t = 0.0, h = 1e-6;
    long found = 0, count = 1;
    rates(p, walls, y, K[0]);
    while (t_end - t > 1e-15) {
        if (h < 1e-15) return -1;
        h = std::min(h, t_end - t);
        for (int s = 1; s < 12; ++s) {
            stage_sum(s, y, K, h, y_stage);
            rates(p, walls, y_stage, K[s]);
        }
        stage_sum(12, y, K, h, y_new);
        rates(p, walls, y_new, K[12]);
        count += 12;
        double sum5 = 0.0, sum3 = 0.0;
        error_sums(K, weights, &sum5, &sum3);
        double error = 0.0;
        if (sum5 != 0.0) error = h * sum5 / std::sqrt((sum5 + 0.01 * sum3) * N);
        if (!(error < 1e300)) error = std::numeric_limits<double>::infinity();
        double factor = error > 0.0 ? 0.9 * std::pow(error, -0.125) : 6.0;
        factor = std::min(6.0, std::max(0.333, factor));
        if (!(error < 1.0)) {
            h *= std::min(factor, 1.0);
            continue;
        }
        double first = 2.0;
        int which = -1;
        const Tip at_end = tip_of(p, y_new);
        for (int i = 0; i < 2; ++i) {
            const double zero = walls[i].on ? JUST_OFF : 0.0, side = 1.0 - 2.0 * i;
            if ((to_wall(p, at_end, side).gap - zero > 0.0) != walls[i].on) continue;
            if (which < 0) {
                for (int s = 13; s < 16; ++s) {
                    stage_sum(s, y, K, h, y_stage);
                    rates(p, walls, y_stage, K[s]);
                }
                count += 3;
                dense_rows(y, y_new, K, h, F);
            }
            // Newton's method with the gap's rate, kept between the signs
            double low = 0.0, high = 1.0, x = 0.5;
            for (int k = 0; k < 60 && (high - low) * h >= 1e-15; ++k) {
                interpolate(y, F, x, inside);
                const Distance to = to_wall(p, tip_of(p, inside), side);
                const bool past = (to.gap - zero > 0.0) == walls[i].on;
                (past ? high : low) = x;
                const double step = -(to.gap - zero) / (to.rate * h);
                // near the end to the other side of the zero, so that the bracket closes
                const double beyond = std::abs(step) < 1e-9 ? (past ? -4e-16 : 4e-16) / h : 0.0;
                x += step + beyond;
                if (!(x > low && x < high)) x = 0.5 * (low + high);
            }
            if (high < first) {
                first = high;
                which = i;
            }
        }
        if (which < 0) {
            t += h;
            std::copy(y_new, y_new + N, y);
            std::copy(K[12], K[12] + N, K[0]);
        } else {
            interpolate(y, F, first, inside);
            t += first * h;
            std::copy(inside, inside + N, y);
            Wall& wall = walls[which];
            if (wall.on) {
                touches[3 * wall.latest + 1] = t;
                wall = Wall();
            } else {
                if (found == room) return -2;
                const double side = 1.0 - 2.0 * which;
                const double rate = to_wall(p, tip_of(p, y), side).rate;
                wall.on = true;
                wall.chi = p.hysteresis * p.K / std::max(-rate, p.v_floor);
                wall.latest = found;
                touches[3 * found] = t;
                touches[3 * found + 1] = std::numeric_limits<double>::quiet_NaN();
                touches[3 * found + 2] = side;
                ++found;
            }
            rates(p, walls, y, K[0]);
            ++count;
        }
        h *= factor;
    }
    *evaluations = count;
    return found;
}
