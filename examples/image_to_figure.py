# %% [markdown]
# # From images to a published figure
#
# Three daylight skies are fitted; the atmosphere that is found then predicts the twilight, which it has not seen, with error
# bars. The pictures ship with diffatmo. They are Monte Carlo of all orders of scattering, with the noise of a sensor, so the
# model that fits them has no part in them.
#
# This notebook is kept twice, as a script and as `.ipynb`; a test holds their cells together and runs them.

# %%
import numpy as np

import diffatmo
import fitting
from diffatmo import color, scene, sun
from diffatmo.cli import shipped
from fitting.figures import Sheet

LEFT_OUT = "sky_93"  # the sun 3° below the horizon

# %% [markdown]
# ## Images
#
# An EXR file rendered by diffatmo knows its camera, its sun and its noise. For a photograph they are arguments of
# `fitting.observe`, which also takes a mask, the saturation and the exposure.

# %%
folder = next(path.parent for path in shipped.scenes() if path.parent.name == "clear")
shots = {path.stem: scene.load(path) for path in sorted(folder.glob("sky_*.exr"))}
observations = {
    name: fitting.observe(
        pixels,
        camera=place.camera,
        altitude=float(place.altitude),
        sun=place.sun,
        noise=notes["monte_carlo_relative_standard_error"],
        noise_shot=1 / notes["electrons_per_unit"],
        noise_floor=notes["read_noise_electrons"] / notes["electrons_per_unit"],
        sun_exclusion=np.radians(2.0),
        name=name,
    )
    for name, (pixels, place, notes) in shots.items()
}

# %% [markdown]
# ## Fit
#
# Everything that can be free is free. Haze and ozone keep the spectra they start with, times a factor.

# %%
result = fitting.fit(
    [observation for name, observation in observations.items() if name != LEFT_OUT],
    init=diffatmo.load(folder / "start.toml"),
    free=[
        "rayleigh_scattering",
        "rayleigh_scale_height",
        "mie_scattering",
        "mie_absorption",
        "mie_scale_height",
        "mie_g",
        "ozone_absorption",
        "ground_albedo",
    ],
    tie={"mie_scattering": "start", "mie_absorption": "start", "ozone_absorption": "start"},
).with_truth(diffatmo.load(folder / "truth.toml"))
print(result.message)

# %% [markdown]
# The result shows itself as a table. As these skies were made, the truth is known, and `pull` says by how many standard errors
# the fit is off.

# %%
result

# %%
result.plot()

# %%
result.plot("correlation")

# %% [markdown]
# `pandas.DataFrame(result.to_rows())` has the same numbers, and so has a CSV file. The whole result goes into one file and
# comes back from it.

# %%
result.to_csv("clear.csv", overwrite=True)
result.save("clear.npz", overwrite=True)
result = fitting.FitResult.load("clear.npz")

# %% [markdown]
# ## A sky that was not fitted
#
# The same air under another sun. The standard error of every pixel follows from the covariance of the fit. Reduced χ² compares
# with the image: it takes the noise and the whole covariance of the prediction, and is 1 on average if both are right.

# %%
prediction = result.predict(shots[LEFT_OUT].scene)
prediction

# %%
left_out = observations[LEFT_OUT]
chi2, pulls = prediction.reduced_chi2(left_out), prediction.pulls(left_out)
print(f"reduced χ² of {LEFT_OUT}: {chi2:.3f}")

# %% [markdown]
# ## The figure
#
# Plain matplotlib. `Sheet` is a `Figure` that a notebook shows without pyplot.

# %%
bands = np.asarray(result.atmosphere.wavelengths)
radiance, error = prediction.radiance, prediction.standard_error
exposure = color.auto_exposure(color.to_linear_srgb(radiance, wavelengths=bands))
measured_shown, predicted_shown = (
    np.asarray(color.display(image, wavelengths=bands, exposure=exposure)) for image in (left_out.image, radiance)
)

relative = 100 * np.mean(error / radiance, axis=-1)
figure = Sheet(figsize=(7.2, 4.2), layout="constrained")
pictures, curves = figure.subfigures(2, 1, height_ratios=(1, 2.4))
axes = pictures.subplots(1, 4)
axes[0].imshow(measured_shown)
axes[1].imshow(predicted_shown)
axes[2].imshow(np.sqrt(bands.size) * np.mean(pulls, axis=-1), vmin=-4, vmax=4, cmap="RdBu_r")
axes[3].imshow(relative, vmin=0, cmap="viridis")
titles = ("measured", "predicted", "(measured − predicted) / σ", "error of the prediction, %")
for panel, title in zip(axes, titles, strict=True):
    panel.set_title(title, fontsize=8)
    panel.set_xticks([])
    panel.set_yticks([])
for panel in axes[2:]:
    bar = pictures.colorbar(panel.images[0], ax=panel, orientation="horizontal", shrink=0.8)
    bar.ax.tick_params(labelsize=7)

# Up from the horizon below which the sun has set: the column of the picture that looks there.
zenith, azimuth = sun.angles(left_out.sun)
column = int(np.degrees(azimuth) / 360 * radiance.shape[1])
elevation = np.degrees(np.arcsin(left_out.directions[:, column, 2]))
panel = curves.subplots()
for channel, (nm, shade) in enumerate(zip(bands, ("tab:red", "tab:green", "tab:blue"), strict=True)):
    center, half = radiance[:, column, channel], error[:, column, channel]
    panel.fill_between(elevation, center - half, center + half, color=shade, alpha=0.3, linewidth=0)
    panel.plot(elevation, center, color=shade, linewidth=1, label=f"{nm:g} nm, predicted ± 1 σ")
    panel.plot(elevation, left_out.image[:, column, channel], ".", color=shade, markersize=3)
panel.set_yscale("log")
panel.set_xlabel("elevation above the sun's azimuth, degrees", fontsize=8)
panel.set_ylabel("radiance / solar irradiance, 1/sr", fontsize=8)
panel.set_title(f"Sun at {np.degrees(zenith):.0f}° from the zenith: dots measured, reduced χ² = {chi2:.2f}", fontsize=8)
panel.tick_params(which="both", labelsize=7)
panel.legend(fontsize=7, frameon=False)
figure.savefig("twilight.pdf")
figure.savefig("twilight.png", dpi=200)
figure
