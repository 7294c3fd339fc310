
/* ---- the optimum without rows, of an axis of @n@ states and @m@ inputs: the same text for every such pair ------------- */

/* Dynamic programming backwards: w_i = k_i, without its feedback -K_i x_i.
 * The cost has the linear terms -2 pull_i' x_{i+1} - 2 push_i' w_i, the latter where push is not NULL. */
static void plan_backwards_@n@x@m@(const struct axis *axis, const real *pull, const real *push, real *w)
{
    enum { n = @n@, m = @m@ };
    real slope[AXIS_STATES], earlier[AXIS_STATES], sum[AXIS_INPUTS];
    int i, j, l, a;
    for (j = 0; j < n; j++) {
        slope[j] = pull[(N - 1) * n + j];
    }
    for (i = N - 1; i >= 0; i--) {
        for (a = 0; a < m; a++) {
            sum[a] = push != NULL ? push[i * m + a] : R(0.0);
            for (j = 0; j < n; j++) {
                sum[a] += axis->B[j * m + a] * slope[j];
            }
        }
        for (a = 0; a < m; a++) {
            w[i * m + a] = R(0.0);
            for (l = 0; l < m; l++) {
                w[i * m + a] += axis->inverse[(i * m + a) * m + l] * sum[l];
            }
        }
        for (j = 0; i > 0 && j < n; j++) {
            earlier[j] = pull[(i - 1) * n + j];
            for (a = 0; push != NULL && a < m; a++) {
                earlier[j] -= axis->K[(i * m + a) * n + j] * push[i * m + a];
            }
            for (l = 0; l < n; l++) {
                earlier[j] += axis->closed[(i * n + l) * n + j] * slope[l];
            }
        }
        for (j = 0; i > 0 && j < n; j++) {
            slope[j] = earlier[j];
        }
    }
}

/* And forwards from x(k): w_i = k_i - K_i x_i, and the values [N][M] of the rows' C x. */
static void plan_forwards_@n@x@m@(const struct axis *axis, const real *start, real *w, real *values)
{
    enum { n = @n@, m = @m@ };
    real x[AXIS_STATES], next[AXIS_STATES];
    int i, j, l, a, c;
    for (j = 0; j < n; j++) {
        x[j] = start[j];
    }
    for (i = 0; i < N; i++) {
        for (j = 0; j < n; j++) {
            next[j] = R(0.0);
            for (a = 0; a < m; a++) {
                next[j] += axis->B[j * m + a] * w[i * m + a];
            }
            for (l = 0; l < n; l++) {
                next[j] += axis->closed[(i * n + j) * n + l] * x[l];
            }
        }
        for (a = 0; a < m; a++) {
            for (j = 0; j < n; j++) {
                w[i * m + a] -= axis->K[(i * m + a) * n + j] * x[j];
            }
        }
        for (c = 0; c < axis->outputs; c++) {
            const real *at = ROWS[axis->row[c]].later ? next : x;
            real value = R(0.0);
            for (j = 0; j < n; j++) {
                value += axis->C[c * n + j] * at[j];
            }
            values[i * M + axis->row[c]] = value;
        }
        for (j = 0; j < n; j++) {
            x[j] = next[j];
        }
    }
}
