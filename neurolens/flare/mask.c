/* The table of a stop's mask, which compiled steps read. Python defines MASK: each mask has a library of its own, so that
   what it points at never changes. */
static const float *mask;
static int mask_cells;
void take_mask(const float *cell, int cells)
{
    mask = cell;
    mask_cells = cells;
}
