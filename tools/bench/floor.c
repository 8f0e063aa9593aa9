/* What the fastest engine could be compared with: the same update in C, and walks over the same memory.
 *
 * One event changes one entry of one volume: an int16 column is added to an int32 projection, moments and
 * sigma follow, the projection is normalised and thresholded in float32, and the pooled sums change by the
 * new code less the old one. The bits are those of streamfeat's kernels; compile with -ffp-contract=off.
 */
#include <math.h>
#include <stdint.h>

typedef uint64_t block __attribute__((vector_size(64), aligned(64), may_alias));

typedef struct {
    int64_t width, entries; /* filters after padding, a multiple of 32; entries of a volume */
    double eps, scale;      /* scale: of the quantised operator, times the unit of codes */
    float threshold;
    const int16_t *columns; /* (entries, width) */
    const float *offset;    /* (width,) */
    int32_t *projections;   /* (volumes, width) */
    int64_t *moments;       /* (volumes, 2): sum, sum of squares */
    int32_t *codes;         /* (volumes, width), or none: the old code is computed again */
    int32_t *pooled;        /* (4, width) */
} floor_state;

static inline int32_t soft(float z, float threshold)
{
    float low = z > -threshold ? z : -threshold;
    return (int32_t)(z - (low < threshold ? low : threshold));
}

static float gain(const floor_state *s, const int64_t *moments)
{
    double mean = (double)moments[0] / (double)s->entries;
    double sigma = sqrt((double)moments[1] / (double)s->entries - mean * mean + s->eps);
    return (float)(s->scale / sigma);
}

/* A volume that is or becomes empty: the code of an empty volume is zero. */
static void move_to_or_from_empty(const floor_state *s, int32_t change, const int16_t *column, int32_t *q,
                                  int32_t *stored, int32_t *pooled, int full, float before, float after)
{
    for (int64_t k = 0; k < s->width; k++) {
        int32_t old = full ? soft((float)q[k] * before - s->offset[k], s->threshold) : 0;
        q[k] += change * column[k];
        int32_t code = full ? 0 : soft((float)q[k] * after - s->offset[k], s->threshold);
        if (stored)
            stored[k] = code;
        pooled[k] += code - old;
    }
}

static void move_computed(int64_t width, int16_t change, const int16_t *restrict column, int32_t *restrict q,
                          int32_t *restrict pooled, const float *restrict offset, float threshold,
                          float before, float after)
{
    for (int64_t k = 0; k < width / 32 * 32; k++) {
        int32_t old = soft((float)q[k] * before - offset[k], threshold);
        int32_t moved = q[k] + (int16_t)(change * column[k]);
        q[k] = moved;
        pooled[k] += soft((float)moved * after - offset[k], threshold) - old;
    }
}

static void move_stored(int64_t width, int16_t change, const int16_t *restrict column, int32_t *restrict q,
                        int32_t *restrict pooled, const float *restrict offset, float threshold,
                        int32_t *restrict stored, float after)
{
    for (int64_t k = 0; k < width / 32 * 32; k++) {
        int32_t moved = q[k] + (int16_t)(change * column[k]);
        int32_t code = soft((float)moved * after - offset[k], threshold);
        q[k] = moved;
        pooled[k] += code - stored[k];
        stored[k] = code;
    }
}

void move_all(const floor_state *s, int64_t n, const int32_t *volume, const int32_t *entry,
              const int32_t *before, const int32_t *after, const int32_t *quadrant)
{
    for (int64_t i = 0; i < n; i++) {
        const int64_t v = volume[i];
        const int16_t *column = s->columns + entry[i] * s->width;
        int32_t *q = s->projections + v * s->width;
        int32_t *pooled = s->pooled + quadrant[v] * s->width;
        int32_t *stored = s->codes ? s->codes + v * s->width : 0;
        int64_t *moments = s->moments + 2 * v;
        const int16_t change = (int16_t)(after[i] - before[i]);
        const float gain_before = gain(s, moments);
        const int64_t squares = moments[1];
        moments[0] += change;
        moments[1] += (int64_t)after[i] * after[i] - (int64_t)before[i] * before[i];
        const float gain_after = gain(s, moments);
        if (squares == 0 || moments[1] == 0)
            move_to_or_from_empty(s, change, column, q, stored, pooled, squares != 0, gain_before, gain_after);
        else if (stored)
            move_stored(s->width, change, column, q, pooled, s->offset, s->threshold, stored, gain_after);
        else
            move_computed(s->width, change, column, q, pooled, s->offset, s->threshold, gain_before, gain_after);
    }
}

/* Read rows of memory one after the other; sizes are bytes, multiples of 64. */
uint64_t read_rows(int64_t n, const int32_t *row, int64_t size, const char *memory)
{
    block a = {0}, b = {0}, c = {0};
    for (int64_t i = 0; i < n; i++) {
        const block *p = (const block *)(memory + row[i] * size);
        int64_t k = 0, blocks = size / 64;
        for (; k + 3 <= blocks; k += 3) {
            a ^= p[k];
            b ^= p[k + 1];
            c ^= p[k + 2];
        }
        for (; k < blocks; k++)
            a ^= p[k];
    }
    a ^= b ^ c;
    return a[0] ^ a[1] ^ a[2] ^ a[3] ^ a[4] ^ a[5] ^ a[6] ^ a[7];
}

/* Read and write rows of memory one after the other. */
void change_rows(int64_t n, const int32_t *row, int64_t size, char *memory)
{
    for (int64_t i = 0; i < n; i++) {
        block *p = (block *)(memory + row[i] * size);
        for (int64_t k = 0; k < size / 64; k++)
            p[k] += 1;
    }
}
