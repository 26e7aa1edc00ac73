# Image of the simulator: docker build --tag airl-mav . && docker run --rm airl-mav
FROM python:3.11-slim AS build
WORKDIR /src
COPY . .
RUN pip install --no-cache-dir --no-deps --require-hashes --requirement requirements/build.txt \
    && pip wheel --no-cache-dir --no-deps --no-build-isolation --wheel-dir /wheels .

FROM python:3.11-slim
COPY --from=build /wheels /wheels
COPY requirements/sim.txt /tmp/sim.txt
RUN pip install --no-cache-dir --no-deps --require-hashes --requirement /tmp/sim.txt \
    && pip install --no-cache-dir --no-deps /wheels/*.whl \
    && rm -r /wheels /tmp/sim.txt \
    && useradd --create-home --uid 1000 airl
USER 1000
WORKDIR /home/airl
# Kernels compile while the image is built, so that a container flies within seconds.
RUN airl sitl --level lockstep --episodes 1 --out /tmp/first && rm -r /tmp/first
ENTRYPOINT ["airl"]
CMD ["sitl", "--level", "lockstep", "--episodes", "3", "--out", "runs/container"]
