"""The exact lens: prescriptions, glass, coatings, the tracer, first-order data, states. Imports only torch and numpy.

    prescription          Lens (`at`, `scaled`), Surface, Coating, Configuration
    lensfile, lenswriter  TOML files
    trace                 trace, compile_trace, Rays, ray differentials; `sequence` follows ghosts
    surfaces, shapes      spheres and planes, conics and aspheres; `passing` one surface with its tests
    paraxial              first_order; `states`, `focusing`, `accessories` (pinhole, filters, hoods) what one changes
    catalogue, glass      dispersion and absorption; `coatings`, `transmission` thin films and polarisation
    pupils, radiometry    where light passes, and how much reaches the film; `pupil_methods` those of the literature
    lenscheck, rims       whether a table agrees with its source, and rims for one without; `aiming` rays to its stop

Cameras use three modules that load without torch: `sag`, `film_plane` and `apertures`.
"""
