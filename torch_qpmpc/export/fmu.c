/* The functions of FMI 3.0 for co-simulation around policy_step.

   The outputs are those of the inputs at the present time, also before the step is made: a master
   that sets the inputs may read them at once, and fmi3DoStep keeps what they were made with. */
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include "policy.h"

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status;
typedef void Log(void *environment, Status status, const char *category, const char *message);
typedef uint32_t Reference;

/* Numbers by their reference, of which 0 is the time; then flags, and the status. PLACE has where a
   number begins among the values, of which the first SETTABLE may be set. */
/* @VARIABLES@ */

typedef struct {
    policy_state state, next; /* before and after a step at this time */
    double time, values[VALUES];
    bool flags[FLAGS_];
    int64_t status;
    bool starts;   /* in initialisation, whose end sets the state */
    bool is_new;   /* inputs were set since the last step */
    bool is_ready; /* outputs and next are those of the inputs */
} Model;

typedef struct {
    Model model;
    Log *log;
    void *environment;
} Instance;

#ifdef POLICY_STAGES
enum { N_Y = POLICY_N_Y, N_U = POLICY_N_U, N_D = POLICY_N_D, SET_POINTS = POLICY_SET_POINTS };
enum { Y = 0, R = N_Y, KNOWN = R + N_Y * SET_POINTS, APPLIED = KNOWN + N_D * POLICY_STAGES };
enum { LAST = APPLIED + N_U, U = LAST + N_U };
enum { MANUAL, RESTS }; /* flags */

/* Turn the stages of each signal into the signals of each stage; a NaN holds the stage before. */
static void by_stage(const double *x, int signals, int stages, policy_real *rows)
{
    int i, k;
    for (i = 0; i < signals; i++)
        for (k = 0; k < stages; k++, x++)
            rows[k * signals + i] = *x != *x && k ? rows[(k - 1) * signals + i] : *x;
}

static void start(Model *m)
{
    policy_real known[POLICY_STAGES * POLICY_N_D_];
    bool rests = m->flags[RESTS];
    by_stage(m->values + KNOWN, N_D, POLICY_STAGES, known);
    policy_reset(&m->state, rests ? m->values + Y : 0, m->values + LAST, rests ? known : 0);
}

static void evaluate(Model *m)
{
    policy_real known[POLICY_STAGES * POLICY_N_D_], r[SET_POINTS * N_Y];
    double *v = m->values;
    by_stage(v + KNOWN, N_D, POLICY_STAGES, known);
    by_stage(v + R, N_Y, SET_POINTS, r);
    if (m->flags[MANUAL]) {
        m->status = policy_observe(&m->next, v + Y, v + APPLIED, known);
        memcpy(v + U, m->next.u, sizeof m->next.u);
    } else {
        m->status = policy_step(&m->next, v + Y, r, known, v + U);
    }
}
#else
enum { U = POLICY_N_P, VALUE = U + POLICY_N_U };

static void start(Model *m) { policy_reset(&m->state); }

static void evaluate(Model *m)
{
    policy_info info;
    m->status = policy_step(&m->next, m->values, m->values + U, &info);
    m->values[VALUE] = info.value;
}
#endif

/* Make the outputs those of the inputs. */
static void refresh(Model *m)
{
    if (m->is_ready) return;
    if (m->starts) start(m);
    m->next = m->state;
    evaluate(m);
    m->is_ready = true;
}

static Status say(Instance *i, Status status, const char *message)
{
    if (i->log) i->log(i->environment, status, "logStatus", message);
    return status;
}

/* Return the value that a reference begins at, and their number. */
static double *find(Instance *i, Reference reference, size_t *size)
{
    *size = 1;
    if (reference == 0) return &i->model.time;
    if (reference > NUMBERS) return 0;
    *size = (size_t)(PLACE[reference] - PLACE[reference - 1]);
    return i->model.values + PLACE[reference - 1];
}

EXPORT Status fmi3GetFloat64(Instance *i, const Reference *vr, size_t n, double *to, size_t left)
{
    size_t k, size;
    if (i->model.is_new) refresh(&i->model);
    for (k = 0; k < n; k++, to += size, left -= size) {
        const double *from = find(i, vr[k], &size);
        if (!from || left < size) return say(i, ERROR, "No number has this reference or size.");
        memcpy(to, from, size * sizeof *to);
    }
    return OK;
}

EXPORT Status fmi3SetFloat64(Instance *i, const Reference *vr, size_t n, const double *from, size_t left)
{
    Model *m = &i->model;
    size_t k, size;
    for (k = 0; k < n; k++, from += size, left -= size) {
        double *to = find(i, vr[k], &size);
        if (!to || left < size || to == &m->time || to >= m->values + SETTABLE)
            return say(i, ERROR, "No input or parameter has this reference or size.");
        memcpy(to, from, size * sizeof *to);
    }
    m->is_new = true, m->is_ready = false;
    return OK;
}

EXPORT Status fmi3GetBoolean(Instance *i, const Reference *vr, size_t n, bool *to, size_t left)
{
    size_t k;
    for (k = 0; k < n && k < left; k++) {
        if (vr[k] <= NUMBERS || vr[k] > NUMBERS + FLAGS) return say(i, ERROR, "No flag has this reference.");
        to[k] = i->model.flags[vr[k] - NUMBERS - 1];
    }
    return OK;
}

EXPORT Status fmi3SetBoolean(Instance *i, const Reference *vr, size_t n, const bool *from, size_t left)
{
    size_t k;
    for (k = 0; k < n && k < left; k++) {
        if (vr[k] <= NUMBERS || vr[k] > NUMBERS + FLAGS) return say(i, ERROR, "No flag has this reference.");
        i->model.flags[vr[k] - NUMBERS - 1] = from[k];
    }
    i->model.is_new = true, i->model.is_ready = false;
    return OK;
}

EXPORT Status fmi3GetInt64(Instance *i, const Reference *vr, size_t n, int64_t *to, size_t left)
{
    size_t k;
    if (i->model.is_new) refresh(&i->model);
    for (k = 0; k < n && k < left; k++) {
        if (vr[k] != NUMBERS + FLAGS + 1) return say(i, ERROR, "No status has this reference.");
        to[k] = i->model.status;
    }
    return OK;
}

EXPORT Status fmi3Reset(Instance *i)
{
    memset(&i->model, 0, sizeof i->model);
    memcpy(i->model.values, START, sizeof START);
    i->model.starts = i->model.is_new = true;
    return OK;
}

EXPORT Instance *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
    bool visible, bool logging, bool events, bool early, const Reference *needed, size_t n_needed,
    void *environment, Log *log, void *update)
{
    Instance *i = strcmp(token, TOKEN) ? 0 : malloc(sizeof *i);
    (void)name, (void)resources, (void)visible, (void)events, (void)early, (void)needed;
    (void)n_needed, (void)update;
    if (!i) return 0;
    i->log = logging ? log : 0;
    i->environment = environment;
    fmi3Reset(i);
    return i;
}

EXPORT void fmi3FreeInstance(Instance *i) { free(i); }

EXPORT Status fmi3EnterInitializationMode(Instance *i, bool tolerates, double tolerance, double time)
{
    (void)tolerates, (void)tolerance;
    i->model.time = time;
    return OK;
}

EXPORT Status fmi3ExitInitializationMode(Instance *i)
{
    start(&i->model);
    i->model.starts = i->model.is_ready = false;
    return OK;
}

EXPORT Status fmi3DoStep(Instance *i, double time, double step, bool forward, bool *event, bool *ends,
    bool *early, double *reached)
{
    Model *m = &i->model;
    double count = (double)(int64_t)(step / STEP + 0.5), off = step / STEP - count;
    (void)forward;
    *event = *ends = *early = false;
    *reached = time;
    if (count < 1 || off > 1e-6 || off < -1e-6)
        return say(i, DISCARD, "The communication step is no multiple of fixedInternalStepSize.");
    for (; count > 0; count--) {
        refresh(m);
        m->state = m->next;
        m->is_new = m->is_ready = false;
    }
    *reached = m->time = time + step;
    return OK;
}

EXPORT Status fmi3GetFMUState(Instance *i, Model **to)
{
    if (!*to && !(*to = malloc(sizeof **to))) return say(i, ERROR, "There is no memory for a state.");
    **to = i->model;
    return OK;
}

EXPORT Status fmi3SetFMUState(Instance *i, const Model *from)
{
    i->model = *from;
    return OK;
}

EXPORT Status fmi3FreeFMUState(Instance *i, Model **state)
{
    (void)i;
    free(*state);
    *state = 0;
    return OK;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

/* There is nothing to do at the end, and of the rest of FMI there is nothing that the model description
   announces; a caller's further arguments are left alone. */
#define DOES(name, result) EXPORT result fmi3##name(void *i)
#define NONE(name) DOES(name, Status) { (void)i; return ERROR; }
#define TYPE(name) NONE(Get##name) NONE(Set##name)

DOES(Terminate, Status) { (void)i; return OK; }
DOES(SetDebugLogging, Status) { (void)i; return OK; }
DOES(InstantiateModelExchange, void *) { (void)i; return 0; }
DOES(InstantiateScheduledExecution, void *) { (void)i; return 0; }
TYPE(Float32) TYPE(Int8) TYPE(UInt8) TYPE(Int16) TYPE(UInt16) TYPE(Int32) TYPE(UInt32) TYPE(UInt64)
TYPE(String) TYPE(Binary) TYPE(Clock) TYPE(IntervalDecimal) TYPE(IntervalFraction) TYPE(ShiftDecimal)
TYPE(ShiftFraction) TYPE(ContinuousStates) NONE(SetInt64) NONE(SetTime)
NONE(SerializeFMUState) NONE(SerializedFMUStateSize) NONE(DeserializeFMUState)
NONE(EnterConfigurationMode) NONE(ExitConfigurationMode) NONE(EnterEventMode) NONE(EnterStepMode)
NONE(EnterContinuousTimeMode) NONE(CompletedIntegratorStep) NONE(ActivateModelPartition)
NONE(EvaluateDiscreteStates) NONE(UpdateDiscreteStates) NONE(GetOutputDerivatives)
NONE(GetDirectionalDerivative) NONE(GetAdjointDerivative) NONE(GetContinuousStateDerivatives)
NONE(GetEventIndicators) NONE(GetNominalsOfContinuousStates) NONE(GetNumberOfContinuousStates)
NONE(GetNumberOfEventIndicators) NONE(GetNumberOfVariableDependencies) NONE(GetVariableDependencies)
