"""The exact lens: prescriptions, glass, coatings, the tracer, first-order data, states. Imports only torch and numpy.

    from neurolens.optics.lensfile import read_lens
    from neurolens.optics.trace import Rays, trace

    lens = read_lens("lenses/laikin_double_gauss_50.toml").at(focus_m=2.0, f_number=4.0)

Where to look:

    prescription     Lens (`at`, `scaled`, `with_filter`, `with_hood`, `pinhole`), Surface, Coating, Configuration
    lensfile, lenswriter                 TOML files
    trace            trace, compile_trace, Rays; `sequence` follows ghosts, `differentials` the derivatives of rays
    paraxial         first_order; `bestfocus`, `breathing`, `zoom`, `internal` what a photographer changes
    glass, catalogue                     dispersion and absorption; `coatings`, `thinfilm`, `polarisation` the films
    pupils, pupil_methods, radiometry    where light passes, and how much reaches the film
    lenscheck, rims, clearance           whether a table can be trusted and built
"""
