"""The exact lens: prescriptions, glass, coatings, the tracer, first-order data, states. Imports only torch and numpy.

    from neurolens.optics.lensfile import read_lens
    from neurolens.optics.trace import Rays, trace

    lens = read_lens("lenses/laikin_double_gauss_50.toml").at(focus_m=2.0, f_number=4.0)

Where to look:

    prescription          Lens (`at`, `scaled`), Surface, Coating, Configuration
    lensfile, lenswriter  TOML files
    trace                 trace, compile_trace, Rays, ray differentials; `sequence` follows ghosts
    surfaces, shapes      spheres and planes, conics and aspheres; `passing` one surface with its tests
    paraxial              first_order; `states`, `focusing`, `accessories` (pinhole, filters, hoods) what one changes
    catalogue, glass      dispersion and absorption; `coatings`, `transmission` thin films and polarisation
    pupils, radiometry    where light passes, and how much reaches the film; `pupil_methods` those of the literature
    lenscheck, rims       whether a table agrees with its source, and rims for one without; `aiming` rays to its stop

Cameras use three modules that load without torch: `sag` (depth, ends and clearance of surfaces), `film_plane` (focus)
and `apertures` (shapes of the stop).
"""
