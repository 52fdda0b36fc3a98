/* Explicit Runge-Kutta methods on y' = f(t, y), from a tableau, for many starts: threads share them.

   f is a function that CasADi has written in C, included before this file as `slope`. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    int stages;
    double order;
    const double *a, *b, *e, *c; /* a: stages x stages, below its diagonal; e: b less the weights of the estimate */
} Tableau;

static void rates(double t, const double *y, double *dy, const double **arg, double **res, casadi_int *iw, double *w) {
    arg[0] = &t;
    arg[1] = y;
    res[0] = dy;
    slope(arg, res, iw, w, 0);
}

/* One start: rows of y at ts into out. steps > 0: so many equal ones between save points, else adaptive ones. */
static int one(const Tableau *m, int n, int nt, const double *ts, const double *y0, double *out, int steps, double tolerance,
               long most, long *counts) {
    casadi_int sz_arg, sz_res, sz_iw, sz_w;
    slope_work(&sz_arg, &sz_res, &sz_iw, &sz_w);
    const double **arg = malloc((sz_arg + 2) * sizeof *arg);
    double **res = malloc((sz_res + 1) * sizeof *res);
    casadi_int *iw = malloc((sz_iw + 1) * sizeof *iw);
    double *w = malloc((sz_w + 1) * sizeof *w);
    double *k = malloc((size_t)(m->stages + 2) * n * sizeof *k), *y = k + m->stages * n, *z = y + n;
    long taken = 0, rejected = 0, calls = 1;
    int fail = 0, fresh = 1;
    double t = ts[0], h = 0;
    memcpy(y, y0, n * sizeof *y);
    memcpy(out, y0, n * sizeof *y);
    rates(t, y, k, arg, res, iw, w);
    if (steps == 0) { /* the first step: a hundredth of y over its rate */
        double size = 0, speed = 0;
        for (int i = 0; i < n; i++) {
            double scale = tolerance * (1 + fabs(y[i]));
            size += y[i] * y[i] / (scale * scale);
            speed += k[i] * k[i] / (scale * scale);
        }
        h = speed > 0 && size > 0 ? 0.01 * sqrt(size / speed) : 1e-6;
    }
    for (int row = 1; row < nt && !fail; row++) {
        double span = ts[row] - ts[row - 1], end = ts[row];
        int done = 0;
        for (int count = 0; !done;) {
            double step = steps ? span / steps : h;
            int last = steps ? count == steps - 1 : t + step >= end * (1 - 1e-15) || t + 1.01 * step >= end;
            if (last) step = end - t;
            if (!fresh) rates(t, y, k, arg, res, iw, w), calls++;
            fresh = 0;
            for (int s = 1; s <= m->stages; s++) { /* the last round makes the new state */
                const double *weights = s < m->stages ? m->a + s * m->stages : m->b;
                memcpy(z, y, n * sizeof *y);
                for (int j = 0; j < s; j++)
                    if (weights[j] != 0)
                        for (int i = 0; i < n; i++) z[i] += step * weights[j] * k[j * n + i];
                if (s < m->stages) rates(t + m->c[s] * step, z, k + s * n, arg, res, iw, w), calls++;
            }
            if (++taken > most) { fail = 1; break; }
            double ratio = 0;
            if (steps == 0) {
                for (int i = 0; i < n; i++) {
                    double e = 0;
                    for (int j = 0; j < m->stages; j++) e += m->e[j] * k[j * n + i];
                    e *= step / (tolerance * (1 + fmax(fabs(y[i]), fabs(z[i]))));
                    ratio += e * e;
                }
                ratio = sqrt(ratio / n);
                double factor = ratio > 0 ? 0.9 * pow(ratio, -1 / m->order) : 5;
                if (!(factor > 0.2)) factor = 0.2;
                if (factor > 5) factor = 5;
                if (!(ratio <= 1)) { /* also where it is not a number; k[0] still belongs to y */
                    h = step * factor, rejected++, fresh = 1;
                    continue;
                }
                if (!last || factor < 1) h = step * factor;
            }
            memcpy(y, z, n * sizeof *y);
            t = last ? end : t + step;
            done = last;
            count++;
        }
        memcpy(out + (size_t)row * n, y, n * sizeof *y);
    }
    counts[0] = taken, counts[1] = rejected, counts[2] = calls;
    free(arg), free(res), free(iw), free(w), free(k);
    return fail;
}

/* All starts: ts (batch, nt), y0 (batch, n), out (batch, nt, n), counts (batch, 3). */
int run(int stages, double order, const double *a, const double *b, const double *e, const double *c, int batch, int n, int nt,
        const double *ts, const double *y0, double *out, int steps, double tolerance, long most, long *counts) {
    Tableau m = {stages, order, a, b, e, c};
    int fails = 0;
#pragma omp parallel for schedule(dynamic) reduction(+ : fails) if (batch > 1)
    for (int i = 0; i < batch; i++)
        fails += one(&m, n, nt, ts + (size_t)i * nt, y0 + (size_t)i * n, out + (size_t)i * nt * n, steps, tolerance, most,
                     counts + 3 * i);
    return fails;
}
