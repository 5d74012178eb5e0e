/* The table of a stop's mask, which the compiled steps read. Python defines MASK, the checksum of the mask: each mask
   has a library of its own, in which the pointer never changes. */
static const float *mask;
static int mask_cells;
void take_mask(const float *cell, int cells)
{
    mask = cell;
    mask_cells = cells;
}
